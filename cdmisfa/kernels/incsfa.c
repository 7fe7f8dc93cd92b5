/* Incremental slow feature analysis: its equations, and learning frame by frame.
 *
 * Sources: candid covariance-free incremental PCA (CCIPCA): Weng, Zhang and Hwang 2003; minor
 * component analysis (MCA) by sequential addition: Peng and Yi 2006; both combined as IncSFA:
 * Kompella, Luciw and Schmidhuber 2012.
 */

/* Share of the largest whitening variance below which a component is rounding noise (decision
 * 0024). The Gram recursion has the energy of a residual to about 1e-15 of the frame's, so above
 * this share it is right to five digits or more; learning frame by frame uses the same rule. */
static const double RANK_TOLERANCE = 1e-10;

/* Variance below which a component is rounding noise, whatever the other variances are. */
static const double LEAST_VARIANCE = 1e-30;

/* Rate of the running mean at the n-th frame (from 1): 1/n, then 2/(window + 1). */
INLINE double mean_rate(int64_t n, double window) {
  return larger(2.0 / (window + 1.0), 1.0 / (double)n);
}

/* Weight of the new frame in CCIPCA at the n-th frame (from 1); the old vector has the rest.
 *
 * Source: Weng et al. 2003, amnesic mean with constants 20, 200, 2000, 3; the counter is one
 * ahead, because the initial vector counts as a frame.
 */
INLINE double amnesic_weight(int64_t n) {
  double k = (double)n + 1.0, amnesia = 0;
  if (k >= 200) amnesia = 3.0 + (k - 200.0) / 2000.0;
  else if (k >= 20) amnesia = 3.0 * (k - 20.0) / 180.0;
  return (1.0 + amnesia) / k;
}

/* Variance up to which a component is rounding noise. Such a component is whitened to 0, does not
 * contribute to phi (see `mca_step`) and does not shrink further; it returns as soon as the input
 * varies along it. */
INLINE double rank_floor(int64_t K, const double *d) {
  double largest = 0;
  for (int64_t k = 0; k < K; k++) largest = larger(largest, d[k]);
  return larger(RANK_TOLERANCE * largest, LEAST_VARIANCE);
}

/* scale_k = d_k^-3/2, which makes u.v_k a component of unit variance; 0 for rounding noise. */
INLINE void whitening_scales(int64_t K, const double *d, double *scale) {
  double floor = rank_floor(K, d);
  for (int64_t k = 0; k < K; k++) scale[k] = d[k] > floor ? 1.0 / (d[k] * sqrt(d[k])) : 0;
}

/* Turn each row of w towards the next slowest direction.
 *
 * Source: Peng and Yi 2006 with sequential addition, as in the authors' IncSFA: gamma = 0.24 / nu,
 * rate nu / (1 + 1.2 j) for output j from 0. A component of rounding noise would look perfectly
 * slow: it counts as unchanged, and its share of a row is halved, so that rows turn to the other
 * components. z_dot (K,) is the change of the whitened frame, step (K,) scratch.
 */
INLINE void mca_step(const incsfa *s, double *z_dot, const double *scale, double *step) {
  int64_t K = s->components;
  double gamma = 0.24 / s->nu;
  for (int64_t k = 0; k < K; k++)
    if (scale[k] == 0) z_dot[k] = 0;
  for (int64_t j = 0; j < s->outputs; j++) {
    double *w = s->w + j * K, rate = s->nu / (1.0 + 1.2 * (double)j);
    double along = dot(z_dot, w, K);
    for (int64_t k = 0; k < K; k++) step[k] = z_dot[k] * along;
    for (int64_t p = 0; p < j; p++)
      add_multiple(dot(s->w + p * K, w, K) * gamma, s->w + p * K, step, K);
    for (int64_t k = 0; k < K; k++) {
      w[k] = fused(1.5 - rate, w[k], -rate * step[k]);
      if (scale[k] == 0) w[k] *= 0.5;
    }
    double length = 1.0 / sqrt(dot(w, w, K));
    for (int64_t k = 0; k < K; k++) w[k] *= length;
  }
}

/* Update the mean with the n-th frame (from 1), and subtract it; the first frame is not centred. */
INLINE void centre(const incsfa *s, int64_t n, double *u) {
  double rate = mean_rate(n, s->window);
  for (int64_t i = 0; i < s->inputs; i++) {
    s->mean[i] = fused(rate, u[i] - s->mean[i], s->mean[i]);
    if (n > 1) u[i] -= s->mean[i];
  }
}

/* Turn the vectors towards the principal components; r becomes the unexplained rest of the frame.
 *
 * v_j <- (1-w) v_j + w (r.v_j)/|v_j| r, then r <- r - (r.v_j) v_j / |v_j|^2.
 */
INLINE void ccipca_step(const incsfa *s, double weight, double *restrict r) {
  int64_t size = s->inputs;
  double floor = rank_floor(s->components, s->d);
  for (int64_t j = 0; j < s->components; j++) {
    double *restrict v = s->v + j * size;
    double keep = s->d[j] > floor ? 1.0 - weight : 1.0;
    double gain = weight / s->d[j] * dot(r, v, size);
    for (int64_t i = 0; i < size; i++) v[i] = fused(gain, r[i], keep * v[i]);
    double square = dot(v, v, size);
    s->d[j] = sqrt(square);
    add_multiple(-dot(r, v, size) / square, v, r, size);
  }
}

enum { VECTORS = 4 }; /* vectors that are read together: rows of images are multiples of 4 KB, so
                         that more of them would use the same lines of L1 */

/* Weights m of the vectors with phi = m v: m = w diag(scale). */
INLINE void features_in_vectors(const incsfa *s, double *scale, double *m) {
  whitening_scales(s->components, s->d, scale);
  for (int64_t j = 0; j < s->outputs; j++)
    for (int64_t k = 0; k < s->components; k++)
      m[j * s->components + k] = s->w[j * s->components + k] * scale[k];
}

/* Set phi to m v in some columns, at most `stride` of them; return the square of its change.
 * `rows` (J, stride) is scratch. */
INLINE double slow_features(const incsfa *s, const double *m, int64_t start, int64_t width,
                            double *rows, int64_t stride) {
  int64_t K = s->components, J = s->outputs;
  for (int64_t j = 0; j < J; j++) memset(rows + j * stride, 0, (size_t)width * sizeof *rows);
  for (int64_t k = 0; k < K; k += VECTORS)
    add_multiplied(J, smaller(VECTORS, K - k), width, m + k, K, s->v + k * s->inputs + start,
                   s->inputs, rows, stride);
  double square = 0;
  for (int64_t j = 0; j < s->outputs; j++) {
    double *phi = s->phi + j * s->inputs + start;
    square += square_distance(rows + j * stride, phi, width);
    for (int64_t i = 0; i < width; i++) phi[i] = rows[j * stride + i];
  }
  return square;
}

/* Learn frame by frame; the bits do not depend on how frames are cut into calls. */
INLINE int update_by_frame(const incsfa *s, const frames *x, int gap, double *xi) {
  int64_t size = s->inputs, K = s->components, J = s->outputs;
  double *u = malloc((size_t)((2 + J) * size + (3 + J) * K) * sizeof *u);
  if (!u) return NO_MEMORY;
  double *r = u + size, *rows = r + size, *z_dot = rows + J * size, *scale = z_dot + K;
  double *step = scale + K, *m = step + K;
  for (int64_t t = 0; t < x->n; t++) {
    int64_t n = ++s->counts[0];
    read_columns(x, t, 0, size, u);
    centre(s, n, u);
    memcpy(r, u, (size_t)size * sizeof *r);
    ccipca_step(s, amnesic_weight(n), r);
    whitening_scales(K, s->d, scale);
    for (int64_t k = 0; k < K; k++) {
      double z = dot(u, s->v + k * size, size) * scale[k];
      z_dot[k] = z - s->z_prev[k];
      s->z_prev[k] = z;
    }
    s->counts[1] = n == 1 || (gap && t == 0);
    xi[t] = NAN;
    if (s->counts[1]) continue;
    mca_step(s, z_dot, scale, step);
    features_in_vectors(s, scale, m);
    xi[t] = sqrt(slow_features(s, m, 0, size, rows, size));
  }
  free(u);
  return 0;
}

int incsfa_by_frame(const incsfa *s, const frames *x, int gap, double *xi) {
  if (s->counts[0] < 0) return NOT_A_STATE;
  if (s->inputs == 5 && s->components == 5 && s->outputs == 1) {
    incsfa paper = *s; /* with constant sizes the compiler unrolls the loops */
    paper.inputs = paper.components = 5, paper.outputs = 1;
    return update_by_frame(&paper, x, gap, xi);
  }
  return update_by_frame(s, x, gap, xi);
}
