/* The gate: which saved module explains a block, by slowness or (CD-MISFA 1.0) by clusters. */

static const double TWO_PI = 6.28318530717958647693;
static const double CONSTANT_VARIANCE = 1e-12; /* variance up to which an input is constant */
static const double BAND = 2;        /* half width of a module's slowness band, in SD (paper) */
static const double FORGOTTEN = 0.5; /* count below which a cluster centre is empty again */

/* Slowness of a signal from E(ydot^2) and Var(y), in cycles a frame; smaller is slower, white noise
 * has 0.2251. A signal without variance has infinite slowness.
 *
 * Equation: 2
 */
double slowness(double derivative, double variance) {
  return variance <= 0 ? INFINITY : sqrt(derivative / variance) / TWO_PI;
}

/* Moments of one output over a block; `derivative` is the mean squared difference of frames. */
typedef struct {
  double mean, variance, derivative;
} moments;

INLINE lanes load_each(const double *y, int64_t step) {
  return (lanes){y[0], y[step], y[2 * step], y[3 * step]};
}

/* Moments of n numbers at a distance of `step`. They are computed relative to the first number, so
 * that a constant has no variance, and no digits are lost to a large mean. */
INLINE moments moments_by(const double *y, int64_t n, int64_t step) {
  lanes aparts = spread(0), squares = aparts, changes = aparts;
  int64_t k = 1;
  for (; k + LANES <= n; k += LANES) {
    lanes now = load_each(y + k * step, step), change = now - load_each(y + (k - 1) * step, step);
    lanes apart = now - spread(y[0]);
    aparts += apart;
    squares = add_product(apart, apart, squares);
    changes = add_product(change, change, changes);
  }
  double apart = sum(aparts), square = sum(squares), derivative = sum(changes);
  for (; k < n; k++) {
    double change = y[k * step] - y[(k - 1) * step], from = y[k * step] - y[0];
    apart += from;
    square = fused(from, from, square);
    derivative = fused(change, change, derivative);
  }
  apart /= (double)n;
  return (moments){y[0] + apart, square / (double)n - apart * apart,
                   derivative / larger((double)(n - 1), 1)};
}

static moments moments_of(const double *y, int64_t n, int64_t step) {
  return step == 1 ? moments_by(y, n, 1) : moments_by(y, n, step);
}

/* Slowness of each output within one block; y (n, J).
 *
 * Equation: 4
 */
void instantaneous_slowness(int64_t n, int64_t J, const double *y, double *eta) {
  for (int64_t j = 0; j < J; j++) {
    moments m = moments_of(y + j, n, J);
    eta[j] = slowness(m.derivative, m.variance);
  }
}

/* Rate of an exponential mean over `window` samples that begins as a plain mean. */
static double window_rate(double window, int64_t count) {
  return larger(2 / (window + 1), 1 / (double)count);
}

/* Centre of a node that is nearest to a block's output, and their root mean square distance; if the
 * node has no centre, -1 and the size of the output itself.
 *
 * CD-MISFA 1.0 has a gate by clusters instead of slowness: a node for each label, that is for each
 * stream, holds centres of the outputs there. Node, winner and error: Luciw, Kompella, Kazerounian
 * and Schmidhuber 2013; clusters with counts: Guedalia, London and Werman 1999. Our choices are in
 * decision 0014 of docs/project/decisions.md.
 */
static int64_t nearest(const agent *a, const double *centres, const double *counts,
                       const double *y, double *distance) {
  int64_t best = -1, length = a->tau * a->outputs;
  double least = INFINITY;
  for (int64_t c = 0; c < a->places; c++) {
    double square = counts[c] > 0 ? square_distance(y, centres + c * length, length) : INFINITY;
    if (square < least) best = c;
    if (square < least) least = square;
  }
  *distance = sqrt((best < 0 ? dot(y, y, length) : least) / (double)length);
  return best;
}

/* CD-MISFA 1.0: update the node of a label with a block's output; return its error, and update the
 * mean error.
 *
 * All counts of all labels decay. The winner moves by 1/count if it is within the radius; else the
 * block replaces the centre with the smallest count.
 */
static double track_clusters(const agent *a, int64_t label, const double *y) {
  memory *m = a->memory;
  int64_t length = a->tau * a->outputs, place = 0;
  double keep = exp_of(-1 / a->rules->roc_memory), error;
  for (int64_t i = 0; i < a->streams * a->places; i++) {
    a->counts[i] *= keep;
    if (a->counts[i] < FORGOTTEN) a->counts[i] = 0;
  }
  double *counts = a->counts + label * a->places;
  double *centres = a->centres + label * a->places * length;
  int64_t winner = nearest(a, centres, counts, y, &error);
  bool near = winner >= 0 && error <= a->rules->roc_radius;
  for (int64_t c = 1; c < a->places; c++)
    if (counts[c] < counts[place]) place = c;
  if (near) place = winner;
  counts[place] = near ? counts[place] + 1 : 1;
  double *centre = centres + place * length;
  for (int64_t i = 0; i < length; i++)
    centre[i] = near ? centre[i] + (y[i] - centre[i]) / counts[place] : y[i];
  double rate = window_rate(a->rules->eta_dot_window, m->novel_blocks);
  m->roc_error = isnan(m->roc_error) ? error : m->roc_error + rate * (error - m->roc_error);
  return error;
}

/* First module (from 1) whose error on a block is below the threshold, or NOVEL; `error` (M,) is
 * NaN for modules that have no centre for the label. */
static int64_t known_to(const agent *a, const frozen *f, int64_t label, const double *y_frozen,
                        double *error) {
  int64_t known_by = NOVEL, length = a->tau * a->outputs;
  for (int64_t m = 0; m < f->modules; m++) {
    int64_t node = (m * a->streams + label) * a->places;
    const double *centres = f->centres + node * length, *counts = f->counts + node;
    if (nearest(a, centres, counts, y_frozen + m * length, &error[m]) < 0) error[m] = NAN;
    if (error[m] < a->rules->roc_error && known_by == NOVEL) known_by = m + 1;
  }
  return known_by;
}

/* Whether no input of a block varies by more than CONSTANT_VARIANCE. */
static bool is_constant(const frames *x) {
  const char *shown = x->pixels ? (const char *)x->pixels : (const char *)x->values;
  size_t row = (size_t)x->size * (x->pixels ? 1 : sizeof *x->values);
  bool same = memcmp(shown + row, shown, (size_t)(x->n - 1) * row) == 0;
  if (same || x->pixels) return same; /* any change of a pixel exceeds the threshold */
  for (int64_t i = 0; i < x->size; i++)
    if (moments_of(x->values + i, x->n, x->size).variance > CONSTANT_VARIANCE) return false;
  return true;
}

/* First module (from 1) that explains a block, or NOVEL. A module does if the slowness of every
 * output within the block, `eta_inst` (M, J), is in its band. */
static int64_t verdict(const agent *a, const frozen *f, const double *y_frozen, double *eta_inst) {
  int64_t known_by = NOVEL, J = a->outputs;
  for (int64_t m = 0; m < f->modules; m++) {
    bool inside = true;
    instantaneous_slowness(a->tau, J, y_frozen + m * a->tau * J, eta_inst + m * J);
    for (int64_t i = m * J; i < (m + 1) * J; i++)
      inside &= fabs(eta_inst[i] - f->band_mean[i]) <= BAND * f->band_sd[i];
    if (inside && known_by == NOVEL) known_by = m + 1;
  }
  return known_by;
}

static bool within(int64_t x, int64_t low, int64_t high) { return low <= x && x < high; }

/* Whether the indices of the memory are in range, and its counts possible. */
static bool is_state(const agent *a) {
  const memory *m = a->memory;
  const int64_t most = (int64_t)1 << 44;
  return within(m->stream, 0, a->streams) && within(m->last_stream, -1, a->streams) &&
         within(m->last_action, 0, 2) && within(m->iteration, 0, most) &&
         within(m->module, 0, most) && within(m->novel_blocks, 0, most) &&
         within(m->rewards, 0, most) && within(m->idle, 0, most) && within(*a->y_frames, 0, most);
}

/* Find what explains the block of the agent's stream: a module (from 1), NOVEL or CONSTANT.
 *
 * `shown` is the raw block, x the expanded one. Written: the modules' outputs y_frozen (M, n, J),
 * all in one pass over the block, their slowness eta_inst (M, J), and their clustering error (M,),
 * NaN except for 1.0.
 */
int recognise(const agent *a, const frozen *f, const frames *shown, const frames *x,
              double *y_frozen, double *eta_inst, double *roc_error) {
  int64_t J = a->outputs, rows = f->modules * J;
  if (!is_state(a)) return NOT_A_STATE;
  double *y = malloc((size_t)(x->n * rows + 1) * sizeof *y);
  if (!y) return NO_MEMORY;
  int code = rows ? outputs(rows, f->phi, f->offset, x, y) : 0;
  for (int64_t m = 0; m < f->modules && code == 0; m++) {
    roc_error[m] = NAN;
    for (int64_t t = 0; t < x->n; t++)
      memcpy(y_frozen + (m * x->n + t) * J, y + t * rows + m * J, (size_t)J * sizeof *y);
  }
  free(y);
  if (code) return code;
  int64_t known_by = verdict(a, f, y_frozen, eta_inst);
  if (a->rules->tabular) known_by = known_to(a, f, a->memory->stream, y_frozen, roc_error);
  a->out->known_by = is_constant(shown) ? CONSTANT : known_by;
  return 0;
}
