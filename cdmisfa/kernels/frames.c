/* Chunks of logs: find their messages, and copy the values in them. */

enum { /* opcode of a message, and sizes of headers */
  MESSAGE = 5,
  BEFORE_RECORD = 9,  /* opcode and length */
  BEFORE_PAYLOAD = 31 /* header of a message, with that of its record */
};

/* Unsigned number of up to eight bytes, the lowest first. */
INLINE uint64_t number(const uint8_t *at, size_t width) {
  uint64_t value = 0;
  memcpy(&value, at, width);
  return value;
}
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers begin with their least byte");

int walk_records(const uint8_t *data, int64_t size, message *messages, int64_t *others,
                 walked *found) {
  *found = (walked){.earliest = UINT64_MAX};
  for (int64_t at = 0;;) {
    const uint8_t *record = data + at;
    found->end = at;
    if (at == size) return 0;
    if (size - at < BEFORE_RECORD || !record[0]) return OUT_OF_ORDER;
    uint64_t length = number(record + 1, 8);
    if (length > (uint64_t)(size - at - BEFORE_RECORD)) return OUT_OF_ORDER;
    if (record[0] == MESSAGE && length < BEFORE_PAYLOAD - BEFORE_RECORD) return OUT_OF_ORDER;
    at += BEFORE_RECORD + (int64_t)length;
    if (record[0] != MESSAGE) {
      if (others) others[2 * found->others] = found->end, others[2 * found->others + 1] = at;
      found->others++;
      continue;
    }
    uint64_t time = number(record + 15, 8);
    if (time < found->earliest) found->earliest = time;
    if (time > found->latest) found->latest = time;
    if (messages)
      messages[found->messages] =
          (message){.log_time = time,
                    .publish_time = number(record + 23, 8),
                    .at = found->end + BEFORE_PAYLOAD,
                    .size = (int64_t)length - (BEFORE_PAYLOAD - BEFORE_RECORD),
                    .sequence = (uint32_t)number(record + 11, 4),
                    .channel = (uint16_t)number(record + 9, 2)};
    found->messages++;
  }
}

int64_t gather(const uint8_t *data, int64_t size, const message *messages, int64_t n,
               uint16_t channel, int64_t start, int64_t stop, const layout *l, uint8_t *out) {
  for (int64_t r = 0; r < l->values; r++)
    if (l->distances[r] < l->width || l->distances[r] > l->least) return OUT_OF_ORDER;
  for (int64_t k = 0; k < l->marks; k++)
    if (l->places[k] < 1 || l->places[k] > l->least) return OUT_OF_ORDER;
  int64_t row = 0;
  for (int64_t i = 0; i < n; i++) {
    if (messages[i].channel != channel) continue;
    if (row++ < start || row > stop) continue;
    int64_t at = messages[i].at, length = messages[i].size;
    if (at < 0 || at > size || length < l->least || length > size - at) return OUT_OF_ORDER;
    const uint8_t *end = data + at + length;
    for (int64_t k = 0; k < l->marks; k++)
      if (end[-l->places[k]] != l->bytes[k]) return OUT_OF_ORDER;
    for (int64_t r = 0; out && r < l->values; r++, out += l->width)
      memcpy(out, end - l->distances[r], (size_t)l->width);
  }
  return row;
}
