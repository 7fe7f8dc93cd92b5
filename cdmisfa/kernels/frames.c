/* Bytes of logs and of images on their way to frames. */

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
