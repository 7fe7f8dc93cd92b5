/* Bytes of logs and of images on their way to frames. */

enum { /* of a log's records: an opcode, and bytes of what stands before something */
  MESSAGE = 5,
  BEFORE_RECORD = 9,  /* opcode and length */
  BEFORE_PAYLOAD = 31 /* of a message, with the record's */
};

/* The unsigned number of up to eight bytes, least first. */
INLINE uint64_t number(const uint8_t *at, size_t width) {
  uint64_t value = 0;
  memcpy(&value, at, width);
  return value;
}
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers begin with their least byte");

int walk_records(const uint8_t *data, int64_t size, message *messages, int64_t *others,
                 int64_t *found) {
  found[0] = found[1] = 0;
  for (int64_t at = 0;;) {
    const uint8_t *record = data + at;
    found[2] = at;
    if (at == size) return 0;
    if (size - at < BEFORE_RECORD || !record[0]) return OUT_OF_ORDER;
    uint64_t length = number(record + 1, 8);
    if (length > (uint64_t)(size - at - BEFORE_RECORD)) return OUT_OF_ORDER;
    if (record[0] == MESSAGE && length < BEFORE_PAYLOAD - BEFORE_RECORD) return OUT_OF_ORDER;
    at += BEFORE_RECORD + (int64_t)length;
    if (record[0] != MESSAGE) {
      if (others) others[2 * found[1]] = found[2], others[2 * found[1] + 1] = at;
      found[1]++;
      continue;
    }
    if (messages)
      messages[found[0]] = (message){.log_time = number(record + 15, 8),
                                     .publish_time = number(record + 23, 8),
                                     .at = found[2] + BEFORE_PAYLOAD,
                                     .size = (int64_t)length - (BEFORE_PAYLOAD - BEFORE_RECORD),
                                     .sequence = (uint32_t)number(record + 11, 4),
                                     .channel = (uint16_t)number(record + 9, 2)};
    found[0]++;
  }
}

int gather(const uint8_t *data, int64_t size, const message *messages, int64_t n, const layout *l,
           uint8_t *out) {
  for (int64_t r = 0; r < l->values; r++)
    if (l->distances[r] < l->width || l->distances[r] > l->least) return OUT_OF_ORDER;
  for (int64_t k = 0; k < l->marks; k++)
    if (l->places[k] < 1 || l->places[k] > l->least) return OUT_OF_ORDER;
  for (int64_t i = 0; i < n; i++) {
    int64_t at = messages[i].at, length = messages[i].size;
    if (at < 0 || at > size || length < l->least || length > size - at) return OUT_OF_ORDER;
    const uint8_t *end = data + at + length;
    for (int64_t k = 0; k < l->marks; k++)
      if (end[-l->places[k]] != l->bytes[k]) return OUT_OF_ORDER;
    for (int64_t r = 0; out && r < l->values; r++, out += l->width)
      memcpy(out, end - l->distances[r], (size_t)l->width);
  }
  return 0;
}

/* A mean by a sum and the weight of each of its bytes, rounded as Pillow does it. */
INLINE uint8_t mean_of(uint32_t total, uint32_t weight) {
  return (uint8_t)((total * weight + (1u << 21)) >> 22);
}

/* One of so many, in 2^-22ths. */
static uint32_t weight_of(int64_t count) {
  return (uint32_t)(0.5 + 1.0 / (double)count * (1 << 22));
}

/* Sums over the areas of a row, (n,), of each in four parts of 16 bits.
 *
 * Eight bytes are summed at once; masks (words, n) say which of eight bytes after eight bytes are
 * in an area. Up to 8 words bytes behind the row are read, and masked.
 */
static void sum_areas(const uint8_t *row, const areas *x, int64_t words, const uint64_t *masks,
                      uint64_t *sums) {
  const uint64_t even = 0x00ff00ff00ff00ff;
  memset(sums, 0, (size_t)x->n * sizeof *sums);
  for (int64_t j = 0; j < words; j++, row += 8, masks += x->n)
    for (int64_t i = 0; i < x->n; i++) {
      uint64_t bytes = number(row + x->starts[i], 8) & masks[i];
      sums[i] += (bytes & even) + ((bytes >> 8) & even);
    }
}

/* Means of the areas of an image: along its rows, rounded, and of those along the columns. */
int average(const uint8_t *image, const areas *across, const areas *down, uint8_t *out) {
  int64_t width = across->n, columns = across->pixels, rows = down->pixels;
  int64_t words = (across->most + 7) / 8, padded = columns + 8 * words;
  size_t numbers = (size_t)(width * (words + 2));
  uint64_t *masks = calloc(numbers * sizeof *masks + (size_t)(padded + rows * width), 1);
  if (!masks) return NO_MEMORY;
  uint64_t *sums = masks + words * width;
  uint32_t *weights = (uint32_t *)(sums + width), *totals = weights + width;
  uint8_t *row = (uint8_t *)(totals + width), *means = row + padded;
  for (int64_t x = 0; x < width; x++) {
    weights[x] = weight_of(across->counts[x]);
    for (int64_t k = 0; k < across->counts[x]; k++)
      masks[k / 8 * width + x] |= (uint64_t)255 << k % 8 * 8;
  }
  for (int64_t y = 0; y < rows; y++) {
    const uint8_t *from = image + y * columns;
    if ((rows - y) * columns < padded) from = memcpy(row, from, (size_t)columns);
    sum_areas(from, across, words, masks, sums);
    for (int64_t x = 0; x < width; x++) {
      uint64_t halves = sums[x] + (sums[x] >> 32);
      means[y * width + x] = mean_of((halves + (halves >> 16)) & 0xffff, weights[x]);
    }
  }
  for (int64_t y = 0; y < down->n; y++) {
    uint32_t weight = weight_of(down->counts[y]);
    const uint8_t *first = means + down->starts[y] * width;
    memset(totals, 0, (size_t)width * sizeof *totals);
    for (int64_t i = 0; i < down->counts[y]; i++)
      for (int64_t x = 0; x < width; x++) totals[x] += first[i * width + x];
    for (int64_t x = 0; x < width; x++) out[y * width + x] = mean_of(totals[x], weight);
  }
  free(masks);
  return 0;
}
