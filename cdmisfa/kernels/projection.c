/* Outputs of slow features on whole blocks of frames, equation (1): y = phi (x - mean). */

enum {
  CHUNK = 256,   /* columns that are scaled at a time */
  TOGETHER = 64, /* frames that are scaled at a time: their chunks stay in L2 for all rows */
  PANEL = 12     /* rows whose chunks stay in L1 for all frames */
};

/* `add_products` for a single row, for which frames need not be copied. */
static void add_products_once(const frames *x, int64_t first, int64_t count, const double *phi,
                              int64_t start, int64_t width, double *e) {
  int64_t t = 0, size = x->size, at = first * size + start;
  if (x->values) {
    add_products(1, count, phi + start, size, x->values + at, size, width, e, 0);
    return;
  }
  const uint8_t *pixels = x->pixels + at;
  for (; t + 8 <= count; t += 8)
    add_products_of(1, 8, phi + start, size, NULL, pixels + t * size, size, width, e + t, 0);
  for (; t < count; t++)
    add_products_of(1, 1, phi + start, size, NULL, pixels + t * size, size, width, e + t, 0);
}

/* y = phi x - offset.
 *
 * The output of a row does not depend on the other rows, nor that of a frame on the other frames.
 */
int outputs(int64_t rows, const double *phi, const double *offset, const frames *x, double *y) {
  int64_t size = x->size, together = smaller(TOGETHER, x->n);
  double *u = malloc((size_t)(together * (CHUNK + rows) + 1) * sizeof *u);
  if (!u) return NO_MEMORY;
  double *e = u + together * CHUNK;
  for (int64_t first = 0; first < x->n; first += together) {
    int64_t count = smaller(together, x->n - first);
    memset(e, 0, (size_t)(rows * together) * sizeof *e);
    for (int64_t start = 0; start < size; start += CHUNK) {
      int64_t width = smaller(CHUNK, size - start);
      if (rows == 1) {
        add_products_once(x, first, count, phi, start, width, e);
        continue;
      }
      for (int64_t t = 0; t < count; t++)
        read_columns(x, first + t, start, width, u + t * CHUNK);
      for (int64_t r = 0; r < rows; r += PANEL)
        add_products(smaller(PANEL, rows - r), count, phi + r * size + start, size, u, CHUNK,
                     width, e + r * together, together);
    }
    for (int64_t t = 0; t < count; t++)
      for (int64_t r = 0; r < rows; r++)
        y[(first + t) * rows + r] = e[r * together + t] - offset[r];
  }
  free(u);
  return 0;
}

/* Output of phi on the mean input: the offset of a centred projection. */
void mean_output(int64_t rows, int64_t size, const double *phi, const double *mean,
                 double *offset) {
  for (int64_t r = 0; r < rows; r++) offset[r] = dot(phi + r * size, mean, size);
}
