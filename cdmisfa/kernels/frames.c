/* Chunks of logs: their messages found, and the values in them copied. */

enum { /* of a log: opcodes, and bytes of what stands before something */
  MESSAGE = 5,
  INDEX = 7,
  BEFORE_RECORD = 9,   /* opcode and length */
  BEFORE_PAIRS = 15,   /* of a message index, with the record's */
  BEFORE_PAYLOAD = 31, /* of a message, with the record's */
  PAIR = 16,           /* log time and place of a message */
  MAX_PARTS = 64       /* most channels of a chunk */
};

/* What is left of a channel's pairs. */
typedef struct {
  uint64_t channel;
  const uint8_t *pair, *end;
} index_part;

/* The unsigned number of up to eight bytes, least first. */
INLINE uint64_t number(const uint8_t *at, size_t width) {
  uint64_t value = 0;
  memcpy(&value, at, width);
  return value;
}
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers begin with their least byte");

static index_part *part_of(uint64_t channel, index_part *parts, int n) {
  for (int k = 0; k < n; k++)
    if (parts[k].channel == channel) return parts + k;
  return NULL;
}

/* How many parts some records of message indexes have, or OUT_OF_ORDER. */
static int index_parts(const uint8_t *index, int64_t size, index_part *parts) {
  int found = 0;
  for (int64_t at = 0; at < size;) {
    if (size - at < BEFORE_PAIRS || index[at] != INDEX || found == MAX_PARTS) return OUT_OF_ORDER;
    uint64_t length = number(index + at + 1, 8), bytes = number(index + at + 11, 4);
    uint64_t channel = number(index + at + BEFORE_RECORD, 2);
    at += BEFORE_PAIRS;
    if (length != bytes + 6 || bytes % PAIR || bytes > (uint64_t)(size - at)) return OUT_OF_ORDER;
    if (part_of(channel, parts, found)) return OUT_OF_ORDER;
    parts[found++] = (index_part){channel, index + at, index + at + bytes};
    at += (int64_t)bytes;
  }
  return found;
}

/* Whether a payload is as long as others of its channel, and has the same bytes in its places. */
static int is_laid_out(const layouts *wanted, int64_t c, const uint8_t *payload, int64_t size) {
  if (size < wanted->least[c]) return 0;
  for (int64_t k = c * wanted->marks; k < (c + 1) * wanted->marks; k++) {
    int64_t place = wanted->places[k];
    if (place < 0 || place > size) return 0;
    if (place && payload[size - place] != wanted->bytes[k]) return 0;
  }
  return 1;
}

/* Check a chunk of messages, and find those of some channels.
 *
 * Every byte of it is accounted for and its index agrees with it; what is not so is left to
 * `replay.mcap.tables` and `replay.recordings.scanner`, which say what is wrong.
 */
int scan(const uint8_t *data, int64_t size, const uint8_t *index, int64_t index_size,
         uint64_t start, uint64_t stop, const layouts *wanted, const int64_t *counts,
         int64_t *seen, int64_t n, int64_t *ends, uint64_t *times) {
  index_part parts[MAX_PARTS];
  int found = index_parts(index, index_size, parts);
  if (found < 0) return OUT_OF_ORDER;
  for (int64_t at = 0; at < size;) {
    const uint8_t *message = data + at;
    if (size - at < BEFORE_PAYLOAD || message[0] != MESSAGE) return OUT_OF_ORDER;
    uint64_t length = number(message + 1, 8), time = number(message + 15, 8);
    if (length < BEFORE_PAYLOAD - BEFORE_RECORD) return OUT_OF_ORDER;
    if (length > (uint64_t)(size - at - BEFORE_RECORD)) return OUT_OF_ORDER;
    if (time < start || time > stop) return OUT_OF_ORDER;
    uint64_t channel = number(message + BEFORE_RECORD, 2);
    index_part *own = part_of(channel, parts, found);
    if (!own || own->pair == own->end) return OUT_OF_ORDER;
    if (number(own->pair, 8) != time || number(own->pair + 8, 8) != (uint64_t)at)
      return OUT_OF_ORDER;
    own->pair += PAIR;
    at += BEFORE_RECORD + (int64_t)length;
    for (int64_t c = 0; c < wanted->channels; c++) {
      if (wanted->ids[c] != (int64_t)channel) continue;
      const uint8_t *payload = message + BEFORE_PAYLOAD;
      if (seen[c] >= counts[c] || !is_laid_out(wanted, c, payload, data + at - payload))
        return OUT_OF_ORDER;
      ends[c * n + seen[c]] = at;
      times[c * n + seen[c]++] = time;
    }
  }
  for (int k = 0; k < found; k++)
    if (parts[k].pair != parts[k].end) return OUT_OF_ORDER;
  for (int64_t c = 0; c < wanted->channels; c++)
    if (seen[c] != counts[c]) return OUT_OF_ORDER;
  return 0;
}

/* Copy the values out of messages that end at places of the data. */
int gather(const uint8_t *data, int64_t size, const int64_t *ends, int64_t n,
           const int64_t *distances, int64_t values, int64_t width, uint8_t *out) {
  int64_t farthest = 0;
  for (int64_t r = 0; r < values; r++) {
    if (distances[r] < width) return OUT_OF_ORDER;
    if (distances[r] > farthest) farthest = distances[r];
  }
  for (int64_t i = 0; i < n; i++)
    if (ends[i] < farthest || ends[i] > size) return OUT_OF_ORDER;
  for (int64_t i = 0; i < n; i++)
    for (int64_t r = 0; r < values; r++, out += width)
      memcpy(out, data + ends[i] - distances[r], (size_t)width);
  return 0;
}
