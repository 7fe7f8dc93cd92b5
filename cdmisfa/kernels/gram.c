/* IncSFA with the Gram matrix of the CCIPCA vectors, the fast way for images.
 *
 * The result equals that of `update_by_frame` up to rounding. All scalars of a frame follow from
 * inner products, in O(K^2); the vectors themselves are read and written once for every four
 * frames. Columns in which all frames of a block are equal (`still`) are read and written once a
 * block. xi has no cancellation. The bits depend on how frames are cut into calls; the learner
 * always cuts by tau.
 */

enum {
  GROUP = 4,      /* frames applied in one pass */
  TILE = 256,     /* columns of a tile: a group's frames in it take 8 KB, a quarter of L1 */
  CELL = 8,       /* neighbouring columns that are treated alike, as changing or still */
  BATCH = 32,     /* cells that are written together */
  ROW = BATCH * CELL + CELL, /* their columns, and padding that keeps rows apart in L1 */
  REFRESH = 1000, /* frames after which the Gram matrix is computed from the vectors again */
  WORTH = 4       /* still columns cost K^2 / 2 multiply-adds to write: too many if a block has
                     fewer than K / WORTH frames */
};

static const double LEAST_SHRINK = 0.01; /* vectors that shrank more are scaled to their length */
static const double DENSE = 0.6; /* share of changing cells above which all count as changing */

/* The columns that change within a block, in place or copied. Columns after the last complete cell
 * belong to no cell and count as changing. */
typedef struct {
  int64_t size, cells;
  const int64_t *at; /* (cells,) offsets of the cells */
  double *mean, *v;  /* (size,) and (K, size) */
} columns;

/* Columns that do not change in a block: all of them together take the time of one column.
 *
 * The centred frames there are a_t p with p = x - mean and numbers a_t, so that the vectors stay
 * combinations of p and of their old values: v becomes beta p + L v. beta, L and the inner products
 * v.p obey the rule of columns, and go through the same passes. `taken` is the share of p that has
 * entered the mean; its sum is far more exact than the product of the remaining shares.
 */
typedef struct {
  int64_t cells, width; /* width K + 2 of the table; 0 if no cell is still */
  const int64_t *at;    /* (cells,) */
  double *p;            /* (CELL cells,) */
  double *table;        /* (K, width) beta, then L, then v.p */
  double *r;            /* (GROUP, width) the group's frames on the table's columns */
  double energy, taken, a[GROUP];
} still;

/* Up to GROUP consecutive frames, and the changes to apply to the vectors. The vectors in memory
 * lack their factors `shrink`, which only one pass in many applies. */
typedef struct {
  double *u;              /* (tiles, GROUP, TILE) centred frames; 0 for missing frames */
  double g[GROUP][GROUP]; /* their inner products */
  double *e;              /* (K, GROUP) with the vectors */
  double *steps;          /* (K, 2 GROUP) gain and take of each frame */
  double *shrink;         /* (K,) product of the factors of each vector */
  double *keep, *gain, *take;                /* (GROUP, K) coefficients of the steps */
  double *m, *m_before;                      /* (J, K) phi = m v; before the group's change */
  double *gram_before, *e_before, *products; /* (K, K), (GROUP, K), (K,) */
  double *scale, *rest, *z_dot, *scratch;    /* (K,) */
  double *rows;                              /* (J, TILE) */
} group;

/* One CCIPCA step on inner products: v_j' = keep_j v_j + gain_j r_j, r -= take_j v_j'.
 *
 * gram and d are updated. energy is |u|^2 of the centred frame; e (K,) are its inner products
 * u.v_j, which are overwritten. Then v_j'.v_i (j < i, upper triangle) becomes v_j'.v_i' and is
 * mirrored. Along a row each product depends on the previous one, so four rows are computed at a
 * time.
 */
static void ccipca_coefficients(const incsfa *s, double weight, double energy, double *restrict e,
                                double *keep, double *gain, double *take) {
  int64_t K = s->components;
  double *gram = s->gram, floor = rank_floor(K, s->d);
  for (int64_t i = 0; i < K; i++) {
    double *restrict row = gram + i * K;
    double kept = s->d[i] > floor ? 1.0 - weight : 1.0, g = weight * e[i] / s->d[i];
    double updated = fused(g, fused(2.0 * kept, e[i], g * energy), kept * kept * row[i]);
    double projection = fused(g, energy, kept * e[i]), t = projection / updated;
    for (int64_t j = i + 1; j < K; j++) {
      row[j] = fused(g, e[j], kept * row[j]);
      e[j] = fused(-t, row[j], e[j]);
    }
    energy = larger(fused(-projection, t, energy), 0);
    row[i] = updated;
    keep[i] = kept, gain[i] = g, take[i] = t;
  }
  for (int64_t first = 0; first < K; first += 4) {
    int64_t stop = smaller(first + 4, K);
    double rest[4] = {0};
    for (int64_t j = first; j < stop; j++)
      for (int64_t i = j + 1; i < stop; i++) {
        double x = fused(gain[i], rest[j - first], keep[i] * gram[j * K + i]);
        rest[j - first] = fused(-take[i], x, rest[j - first]);
        gram[j * K + i] = gram[i * K + j] = x;
      }
    for (int64_t i = stop; i < K; i++)
      for (int64_t j = 0; j < 4; j++) {
        double x = fused(gain[i], rest[j], keep[i] * gram[(first + j) * K + i]);
        rest[j] = fused(-take[i], x, rest[j]);
        gram[(first + j) * K + i] = gram[i * K + first + j] = x;
      }
  }
  for (int64_t i = 0; i < K; i++) s->d[i] = sqrt(gram[i * K + i]);
}

/* Update the inner products of a group with the vectors after one step. Any linear functional obeys
 * f_j' = keep_j f_j + gain_j rho; rho -= take_j f_j'. rho are those with the step's frame. */
static void follow(int64_t K, double *e, lanes rho, const double *keep, const double *gain,
                   const double *take) {
  for (int64_t j = 0; j < K; j++) {
    lanes f = add_product(spread(gain[j]), rho, spread(keep[j]) * load(e + j * GROUP));
    rho = add_product(spread(-take[j]), f, rho);
    store(e + j * GROUP, f);
  }
}

/* Length xi of the change of phi over the frames [first, last] of a group, without cancellation:
 * phi' - phi = D v + sum_t delta_t u_t, with D and delta from the adjoint of the CCIPCA steps. */
static double change_of_features(const incsfa *s, const group *w, int64_t first, int64_t last) {
  int64_t K = s->components;
  double xi = 0, *change = w->scratch, delta[GROUP];
  for (int64_t r = 0; r < s->outputs; r++) {
    memcpy(change, w->m + r * K, (size_t)K * sizeof *change);
    for (int64_t t = last; t >= first; t--) {
      double along = 0;
      for (int64_t k = K - 1; k >= 0; k--) {
        double x = fused(-w->take[t * K + k], along, change[k]);
        along = fused(w->gain[t * K + k], x, along);
        change[k] = w->keep[t * K + k] * x;
      }
      delta[t] = along;
    }
    for (int64_t k = 0; k < K; k++) change[k] -= w->m_before[r * K + k];
    for (int64_t p = first; p <= last; p++) {
      xi = fused(2.0 * delta[p], dot(w->e_before + p * K, change, K), xi);
      for (int64_t q = first; q <= last; q++) xi = fused(delta[p] * delta[q], w->g[p][q], xi);
    }
    for (int64_t k = 0; k < K; k++) w->products[k] = dot(w->gram_before + k * K, change, K);
    xi += dot(change, w->products, K);
  }
  return sqrt(larger(xi, 0));
}

/* Learn from a group's inner products: everything except `v` and `phi`.
 *
 * With `pending`, phi is older than the vectors, so that its change is computed from phi itself.
 */
static void learn_group(const incsfa *s, group *w, int64_t count, int gap, int pending,
                        double *xi) {
  int64_t K = s->components, J = s->outputs, first = 0;
  memset(w->steps, 0, (size_t)(K * 2 * GROUP) * sizeof(double));
  for (int64_t t = 0; t < count; t++) {
    double *keep = w->keep + t * K, *gain = w->gain + t * K, *take = w->take + t * K;
    if (!(gap && t == 1)) {
      first = t;
      if (s->counts[0] > 0) memcpy(w->m_before, w->m, (size_t)(J * K) * sizeof(double));
      else memset(w->m_before, 0, (size_t)(J * K) * sizeof(double));
      memcpy(w->gram_before, s->gram, (size_t)(K * K) * sizeof(double));
      for (int64_t p = t; p < smaller(t + 2, GROUP); p++)
        for (int64_t k = 0; k < K; k++) w->e_before[p * K + k] = w->e[k * GROUP + p];
    }
    for (int64_t k = 0; k < K; k++) w->rest[k] = w->e[k * GROUP + t];
    ccipca_coefficients(s, amnesic_weight(s->counts[0] + 1), w->g[t][t], w->rest, keep, gain, take);
    follow(K, w->e, load(w->g[t]), keep, gain, take);
    features_in_vectors(s, w->scale, w->m);
    for (int64_t k = 0; k < K; k++) {
      w->shrink[k] *= keep[k];
      w->steps[k * 2 * GROUP + 2 * t] = gain[k] / w->shrink[k];
      w->steps[k * 2 * GROUP + 2 * t + 1] = -take[k] * w->shrink[k];
      double z = w->e[k * GROUP + t] * w->scale[k];
      w->z_dot[k] = z - s->z_prev[k];
      s->z_prev[k] = z;
    }
    s->counts[0]++;
    s->counts[1] = gap && t == 0;
    if (s->counts[1]) {
      xi[t] = NAN;
      continue;
    }
    mca_step(s, w->z_dot, w->scale, w->scratch);
    features_in_vectors(s, w->scale, w->m);
    if (!pending) xi[t] = change_of_features(s, w, first, t);
  }
}

/* Centre `count` frames in the columns of a tile, see `centre`; 0 for missing frames.
 *
 * `rate` are the rates of the mean, 0 for missing frames.
 */
INLINE void centre_tile(const frames *x, int pixels, int64_t first, int64_t count,
                        const columns *c, int64_t start, const double *rate, double *u) {
  int64_t width = smaller(TILE, c->size - start), whole = smaller(CELL * c->cells - start, width);
  int64_t row[GROUP], beyond = x->size - c->size;
  for (int64_t s = 0; s < GROUP; s++) row[s] = smaller(first + s, first + count - 1) * x->size;
  for (int64_t i = 0; i < whole; i += LANES) {
    int64_t at = c->at[(start + i) / CELL] * CELL + i % CELL;
    lanes m = load(c->mean + start + i);
#pragma GCC unroll 4
    for (int64_t s = 0; s < GROUP; s++) {
      lanes value = read_lanes(x, pixels, row[s] + at);
      m = add_product(spread(rate[s]), value - m, m);
      store(u + s * TILE + i, value - m);
    }
    store(c->mean + start + i, m);
  }
  for (int64_t i = whole < 0 ? 0 : whole; i < width; i++)
    for (int64_t s = 0; s < count; s++) {
      double value = read_value(x, row[s] + beyond + start + i), *m = c->mean + start + i;
      *m = fused(rate[s], value - *m, *m);
      u[s * TILE + i] = value - *m;
    }
  for (int64_t s = count; s < GROUP; s++) memset(u + s * TILE, 0, TILE * sizeof *u);
}

/* Undo the centring of the very first frame in a tile of all columns. */
static void first_frame(const frames *x, const columns *c, int64_t start, double *u) {
  int64_t width = smaller(TILE, c->size - start);
  for (int64_t i = 0; i < width; i++) {
    int64_t cell = (start + i) / CELL;
    int64_t at = cell < c->cells ? c->at[cell] * CELL + i % CELL : x->size - c->size + start + i;
    u[i] = read_value(x, at);
  }
}

/* Apply a group's steps to all vectors in a tile of columns:
 * v_j <- v_j + gain_tj r_t; r_t <- r_t + take_tj v_j for each frame t. */
static void apply_tile(int64_t K, double *v, int64_t v_row, int64_t width, double *r,
                       int64_t r_row, const double *steps) {
  for (int64_t panel = 0; panel < K; panel += VECTORS) {
    int64_t stop = smaller(panel + VECTORS, K), i = 0;
    for (; i + 2 * LANES <= width; i += 2 * LANES) {
      lanes a[GROUP], b[GROUP];
#pragma GCC unroll 4
      for (int t = 0; t < GROUP; t++) {
        a[t] = load(r + t * r_row + i);
        b[t] = load(r + t * r_row + i + LANES);
      }
      for (int64_t j = panel; j < stop; j++) {
        double *to = v + j * v_row + i;
        const double *step = steps + j * 2 * GROUP;
        lanes x = load(to), y = load(to + LANES);
#pragma GCC unroll 4
        for (int t = 0; t < GROUP; t++) {
          lanes gain = spread(step[2 * t]), take = spread(step[2 * t + 1]);
          x = add_product(gain, a[t], x);
          y = add_product(gain, b[t], y);
          a[t] = add_product(take, x, a[t]);
          b[t] = add_product(take, y, b[t]);
        }
        store(to, x);
        store(to + LANES, y);
      }
#pragma GCC unroll 4
      for (int t = 0; t < GROUP; t++) {
        store(r + t * r_row + i, a[t]);
        store(r + t * r_row + i + LANES, b[t]);
      }
    }
    for (; i < width; i++)
      for (int64_t j = panel; j < stop; j++)
        for (int64_t t = 0; t < GROUP; t++) {
          double *x = v + j * v_row + i, *rest = r + t * r_row + i;
          *x = fused(steps[j * 2 * GROUP + 2 * t], *rest, *x);
          *rest = fused(steps[j * 2 * GROUP + 2 * t + 1], *x, *rest);
        }
  }
}

/* Multiply each vector with its factor. */
static void scale_tile(int64_t K, double *v, int64_t v_row, int64_t width, const double *shrink) {
  for (int64_t j = 0; j < K; j++)
    for (int64_t i = 0; i < width; i++) v[j * v_row + i] *= shrink[j];
}

/* Centre the next group in the still columns, and add their share to the inner products. */
static void measure_still(const incsfa *s, still *t, group *w, int64_t count) {
  int64_t K = s->components, seen = s->counts[0];
  memset(t->r, 0, (size_t)(GROUP * t->width) * sizeof(double));
  memset(t->a, 0, sizeof t->a);
  for (int64_t q = 0; q < count; q++) {
    t->taken = fused(mean_rate(seen + q + 1, s->window), 1.0 - t->taken, t->taken);
    t->a[q] = seen + q == 0 ? 1.0 : 1.0 - t->taken;
    t->r[q * t->width] = t->a[q];
    t->r[q * t->width + K + 1] = t->a[q] * t->energy;
  }
  for (int64_t q = 0; q < GROUP; q++) {
    for (int64_t p = 0; p < GROUP; p++)
      w->g[q][p] = fused(t->a[q] * t->a[p], t->energy, w->g[q][p]);
    for (int64_t j = 0; j < K; j++)
      w->e[j * GROUP + q] = fused(t->table[j * t->width + K + 1], t->a[q], w->e[j * GROUP + q]);
  }
}

/* Apply a group of `applied` frames to the vectors, and centre and measure the next group.
 *
 * `settle` applies `shrink`; with `shown`, phi is updated too. The next group has `count` frames
 * from `first` on. Returns the square of the change of phi.
 */
static double run_pass(const incsfa *s, const columns *c, still *t, group *w, int64_t applied,
                       int settle, int shown, const frames *x, int64_t first, int64_t count) {
  int64_t K = s->components;
  double square = 0, rate[GROUP];
  memset(w->g, 0, sizeof w->g);
  memset(w->e, 0, (size_t)(K * GROUP) * sizeof(double));
  for (int64_t q = 0; q < GROUP; q++)
    rate[q] = q < count ? mean_rate(s->counts[0] + q + 1, s->window) : 0;
  if (t->width) {
    if (applied) apply_tile(K, t->table, t->width, t->width, t->r, t->width, w->steps);
    if (settle) scale_tile(K, t->table, t->width, t->width, w->shrink);
    if (count) measure_still(s, t, w, count);
  }
  for (int64_t start = 0; start < c->size; start += TILE) {
    int64_t width = smaller(TILE, c->size - start);
    double *v = c->v + start, *u = w->u + start * GROUP;
    if (applied) apply_tile(K, v, c->size, width, u, TILE, w->steps);
    if (settle) scale_tile(K, v, c->size, width, w->shrink);
    if (shown) square += slow_features(s, w->m, start, width, w->rows, TILE);
    if (!count) continue;
    if (x->pixels) centre_tile(x, 1, first, count, c, start, rate, u);
    else centre_tile(x, 0, first, count, c, start, rate, u);
    if (s->counts[0] == 0) first_frame(x, c, start, u);
    add_products(GROUP, GROUP, u, TILE, u, TILE, width, w->g[0], GROUP);
    add_products(K, GROUP, v, c->size, u, TILE, width, w->e, GROUP);
  }
  for (int64_t k = 0; k < K; k++) {
    if (settle) w->shrink[k] = 1;
    for (int64_t q = 0; q < GROUP; q++) w->e[k * GROUP + q] *= w->shrink[k];
  }
  return square;
}

/* Note the cells, of some words of eight bytes each, in which two frames differ. */
INLINE void note_changes(int64_t cells, int words, const char *one, const char *other,
                         uint64_t *restrict changed) {
  for (int64_t c = 0; c < cells; c++)
    for (int64_t k = 0; k < words; k++) {
      uint64_t a, b;
      memcpy(&a, one + (c * words + k) * 8, 8);
      memcpy(&b, other + (c * words + k) * 8, 8);
      changed[c] |= a ^ b;
    }
}

/* Write the cells that change within a block, in order, and after them the still cells; return the
 * number of changing cells: all of them if too few are still. `changed` has one word a cell. */
static int64_t find_changing(const incsfa *s, const frames *x, uint64_t *restrict changed,
                             int64_t *cells) {
  int64_t every = s->inputs / CELL, count = 0;
  size_t item = x->pixels ? 1 : sizeof(double);
  const char *data = x->pixels ? (const char *)x->pixels : (const char *)x->values;
  int worth = x->n * WORTH >= s->components;
  memset(changed, 0, (size_t)every * sizeof *changed);
  for (int64_t t = x->n - 1; worth && t > 0; t--) { /* the last frame differs most often */
    const char *row = data + (size_t)(t * x->size) * item;
    if (x->pixels) note_changes(every, 1, data, row, changed);
    else note_changes(every, CELL, data, row, changed);
    if (t > 1 && t < x->n - 1) continue;
    count = 0;
    for (int64_t c = 0; c < every; c++) count += changed[c] != 0;
    worth = (double)count <= DENSE * (double)every;
  }
  int64_t moving = 0, resting = worth ? count : every;
  for (int64_t c = 0; c < every; c++) cells[changed[c] || !worth ? moving++ : resting++] = c;
  return moving;
}

/* Copy the columns of a cell; the size is a constant for the compiler. */
INLINE void copy_cell(const double *from, double *to) { memcpy(to, from, CELL * sizeof *to); }

/* Copy the columns of some cells, and those after the last complete cell, out of rows or back. */
static void copy_columns(int64_t rows, double *all, int64_t size, const columns *c, double *few,
                         int back) {
  int64_t beyond = size % CELL;
  for (int64_t j = 0; j < rows; j++) {
    double *own = all + j * size, *part = few + j * c->size;
    for (int64_t n = 0; n < c->cells; n++)
      if (back) copy_cell(part + n * CELL, own + c->at[n] * CELL);
      else copy_cell(own + c->at[n] * CELL, part + n * CELL);
    double *rest = own + size - beyond, *last = part + c->size - beyond;
    for (int64_t i = 0; i < beyond; i++)
      if (back) rest[i] = last[i];
      else last[i] = rest[i];
  }
}

/* Inner products of some vectors with p; their number is a constant at each call. */
INLINE void products_with_still(int vectors, const double *v, int64_t v_row, const still *t,
                                double *out, int64_t out_row) {
  lanes s[4][2];
#pragma GCC unroll 4
  for (int j = 0; j < vectors; j++) s[j][0] = s[j][1] = spread(0);
  for (int64_t n = 0; n < t->cells; n++) {
    lanes x = load(t->p + n * CELL), y = load(t->p + n * CELL + LANES);
#pragma GCC unroll 4
    for (int j = 0; j < vectors; j++) {
      const double *from = v + j * v_row + t->at[n] * CELL;
      s[j][0] = add_product(load(from), x, s[j][0]);
      s[j][1] = add_product(load(from + LANES), y, s[j][1]);
    }
  }
#pragma GCC unroll 4
  for (int j = 0; j < vectors; j++) out[j * out_row] = sum(s[j][0] + s[j][1]);
}

/* Set p, its energy and the table before the first frame of a block. */
static void begin_still(const incsfa *s, const frames *x, still *t) {
  int64_t K = s->components, j = 0;
  for (int64_t n = 0; n < t->cells; n++)
    for (int64_t i = 0; i < CELL; i++)
      t->p[n * CELL + i] = read_value(x, t->at[n] * CELL + i) - s->mean[t->at[n] * CELL + i];
  t->energy = dot(t->p, t->p, t->cells * CELL);
  memset(t->table, 0, (size_t)(K * t->width) * sizeof(double));
  for (int64_t k = 0; k < K; k++) t->table[k * t->width + 1 + k] = 1;
  for (; j + 4 <= K; j += 4)
    products_with_still(4, s->v + j * s->inputs, s->inputs, t, t->table + j * t->width + K + 1,
                        t->width);
  for (; j < K; j++)
    products_with_still(1, s->v + j * s->inputs, s->inputs, t, t->table + j * t->width + K + 1,
                        t->width);
}

/* Write mean and vectors at the end of a block in the still columns. `before` has (K + 1 + 3, ROW).
 * L is lower triangular: three rows need the columns up to the last of them. */
static void settle_still(const incsfa *s, const still *t, double *before) {
  int64_t K = s->components, row = ROW;
  double *after = before + (K + 1) * row;
  for (int64_t first = 0; first < t->cells; first += BATCH) {
    int64_t few = smaller(BATCH, t->cells - first);
    const int64_t *at = t->at + first;
    memcpy(before, t->p + first * CELL, (size_t)(few * CELL) * sizeof(double));
    for (int64_t k = 0; k < K; k++)
      for (int64_t n = 0; n < few; n++)
        copy_cell(s->v + k * s->inputs + at[n] * CELL, before + (k + 1) * row + n * CELL);
    for (int64_t j = 0; j < K; j += 3) {
      int64_t stop = smaller(j + 3, K);
      multiply(stop - j, stop + 1, few * CELL, t->table + j * t->width, t->width, before, row,
               after, row);
      for (int64_t k = j; k < stop; k++)
        for (int64_t n = 0; n < few; n++)
          copy_cell(after + (k - j) * row + n * CELL, s->v + k * s->inputs + at[n] * CELL);
    }
    for (int64_t n = 0; n < few * CELL; n++) {
      double *mean = s->mean + at[n / CELL] * CELL + n % CELL;
      *mean = fused(t->taken, before[n], *mean);
    }
  }
}

/* Number of frames of the next group: up to GROUP, but fewer if phi is older than the vectors; the
 * group then ends with the frame whose change is computed from phi itself. */
static int64_t group_length(int64_t left, int pending, int gap) {
  return smaller(left, pending ? (gap ? 2 : 1) : GROUP);
}

/* Learn all groups of a block, one after the other; return whether phi must be updated. */
static int learn_groups(const incsfa *s, const frames *x, int gap, int pending, const columns *c,
                        still *t, group *w, double *xi) {
  for (int64_t start = 0, count = 0;;) {
    int new_episode = gap && start == 0;
    learn_group(s, w, count, new_episode, pending, xi + start);
    start += count;
    int told = pending && s->counts[1] == 0;
    pending = pending && !told;
    int64_t next = group_length(x->n - start, pending, gap && start == 0);
    int last = next == 0, shown = told || (last && s->counts[1] == 0), settle = shown || last;
    for (int64_t k = 0; k < s->components; k++) settle = settle || w->shrink[k] < LEAST_SHRINK;
    double square =
        run_pass(s, c, t, w, count, settle, shown && !t->width, x, start, next);
    if (told) xi[start - 1] = sqrt(square);
    if (last) return shown;
    count = next;
  }
}

int incsfa_by_gram(const incsfa *s, const frames *x, int gap, double *xi) {
  int64_t size = s->inputs, K = s->components, J = s->outputs, every = size / CELL;
  if (s->counts[0] < 0 || s->counts[2] < 0) return NOT_A_STATE;
  if (x->n == 0) return 0;
  int pending = s->counts[1] == 1;
  gap = gap || s->counts[0] == 0;
  int64_t tiles = (size + TILE - 1) / TILE;
  int64_t needed = 2 * every + tiles * GROUP * TILE + K * (7 * GROUP + 6) + K * K + 2 * J * K +
                   J * TILE + every * CELL + (K + GROUP) * (K + 2) + (K + 4) * ROW;
  double *memory = malloc((size_t)needed * sizeof *memory), *spare = memory, *copies = NULL;
  if (!memory) return NO_MEMORY;
  int64_t *cells = (int64_t *)take(&spare, every);
  columns c = {size, every, cells, s->mean, s->v};
  uint64_t *changed = (uint64_t *)take(&spare, every);
  if (pending)
    for (int64_t n = 0; n < every; n++) cells[n] = n;
  else
    c.cells = find_changing(s, x, changed, cells);
  still t = {.cells = every - c.cells, .at = cells + c.cells, .width = c.cells < every ? K + 2 : 0};
  if (t.width) {
    c.size = c.cells * CELL + size % CELL;
    copies = malloc((size_t)((K + 1) * c.size + 1) * sizeof *copies);
    if (!copies) {
      free(memory);
      return NO_MEMORY;
    }
    c.mean = copies;
    c.v = copies + c.size;
    copy_columns(1, s->mean, size, &c, c.mean, 0);
    copy_columns(K, s->v, size, &c, c.v, 0);
    t.p = take(&spare, t.cells * CELL);
    t.table = take(&spare, K * t.width);
    t.r = take(&spare, GROUP * t.width);
    begin_still(s, x, &t);
  }
  if (s->counts[2] == 0 || s->counts[2] >= REFRESH) {
    memset(s->gram, 0, (size_t)(K * K) * sizeof(double));
    for (int64_t start = 0; start < size; start += TILE)
      add_products(K, K, s->v + start, size, s->v + start, size, smaller(TILE, size - start),
                   s->gram, K);
    s->counts[2] = 0;
  }
  s->counts[2] += x->n;
  group w = {.u = take(&spare, tiles * GROUP * TILE)};
  w.e = take(&spare, K * GROUP);
  w.steps = take(&spare, K * 2 * GROUP);
  w.keep = take(&spare, K * GROUP);
  w.gain = take(&spare, K * GROUP);
  w.take = take(&spare, K * GROUP);
  w.e_before = take(&spare, K * GROUP);
  w.gram_before = take(&spare, K * K);
  w.m = take(&spare, J * K);
  w.m_before = take(&spare, J * K);
  w.rows = take(&spare, J * TILE);
  w.shrink = take(&spare, K);
  w.products = take(&spare, K);
  w.scale = take(&spare, K);
  w.rest = take(&spare, K);
  w.z_dot = take(&spare, K);
  w.scratch = take(&spare, K);
  for (int64_t k = 0; k < K; k++) w.shrink[k] = 1;
  features_in_vectors(s, w.scale, w.m);
  int shown = learn_groups(s, x, gap, pending, &c, &t, &w, xi);
  if (t.width) {
    copy_columns(1, s->mean, size, &c, c.mean, 1);
    copy_columns(K, s->v, size, &c, c.v, 1);
    settle_still(s, &t, take(&spare, (K + 4) * ROW));
    for (int64_t start = 0; shown && start < size; start += TILE)
      slow_features(s, w.m, start, smaller(TILE, size - start), w.rows, TILE);
  }
  free(copies);
  free(memory);
  return 0;
}

/* Learn from consecutive frames (n, I).
 *
 * The first frame after a gap, and the very first, update mean and whitening only. xi (n,) receives
 * the change of phi at each frame, NaN at these frames.
 */
int incsfa_update(const incsfa *s, const frames *x, int gap, double *xi) {
  return s->inputs < MANY_INPUTS ? incsfa_by_frame(s, x, gap, xi) : incsfa_by_gram(s, x, gap, xi);
}
