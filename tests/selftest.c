/* Every kernel on inputs that are the same everywhere, and a hash of what it gives.
 *
 * `test_bits.py` puts this behind the kernels, as one unit, and compares the hashes of compilers
 * and processors. Each array is a block of memory of its own, so that sanitizers see its ends.
 */
#include <stdio.h>

/* The next 64 bits of splitmix64. */
static uint64_t word(void) {
  static uint64_t state = 1;
  uint64_t z = state += 0x9e3779b97f4a7c15;
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9;
  z = (z ^ (z >> 27)) * 0x94d049bb133111eb;
  return z ^ (z >> 31);
}

static int64_t below(int64_t n) { return (int64_t)(word() % (uint64_t)n); }

/* Zeros, that stay reachable: what is lost is lost by a kernel. */
static void *room(int64_t bytes) {
  static void *kept[4000];
  static int n;
  if (n == 4000 || !(kept[n] = calloc((size_t)bytes, 1))) abort();
  return kept[n++];
}

/* Numbers between -scale / 2 and scale / 2. */
static double *doubles(int64_t n, double scale) {
  double *x = room(n * 8);
  for (int64_t i = 0; i < n; i++) x[i] = ((double)(word() >> 11) * 0x1p-53 - 0.5) * scale;
  return x;
}

static uint8_t *bytes(int64_t n) {
  uint8_t *x = room(n);
  for (int64_t i = 0; i < n; i++) x[i] = (uint8_t)word();
  return x;
}

/* The hash (FNV-1a) of all that is added until it is told. */
static uint64_t hash = 0xcbf29ce484222325;

static void add(const void *x, int64_t n) {
  for (int64_t i = 0; i < n; i++) hash = (hash ^ ((const uint8_t *)x)[i]) * 0x100000001b3;
}

static void add_number(int64_t x) { add(&x, sizeof x); }

static void tell(const char *kernel) {
  printf("%s %016llx\n", kernel, (unsigned long long)hash);
  hash = 0xcbf29ce484222325;
}

static void test_elementary(void) {
  enum { N = 20000 };
  const double edges[] = {0, -0.0, 1, 0x1p-1074, 0x1p-1022, 709.78, 709.79, -745.1, -746, 1e300,
                          -1e300, INFINITY, -INFINITY, NAN};
  double *x = doubles(N, 1500), *out = room(N * 8);
  memcpy(x, edges, sizeof edges);
  for (int i = 0; i < N; i++) out[i] = exp_of(x[i]);
  add(out, N * 8);
  tell("exp_of");
  for (int i = 0; i < N; i++) out[i] = log_of(i < 100 ? x[i] : from_bits(word() >> 1));
  add(out, N * 8);
  tell("log_of");
  x = doubles(N, 2e6);
  memcpy(x, edges, sizeof edges);
  sines(x, N, out);
  add(out, N * 8);
  tell("sines");
  cosines(x, N, out);
  add(out, N * 8);
  tell("cosines");
  uint64_t *words = room(2 * N * 8);
  for (int i = 0; i < 2 * N; i++) words[i] = word();
  add_number(normals(words, 2 * N, out, N));
  add(out, N * 8);
  add_number(normals(words, N, out, N));
  tell("normals");
}

/* So many frames of pixels or of values; in some columns all are the same. */
static frames some_frames(int64_t n, int64_t size, int pixels) {
  uint8_t *p = bytes(n * size);
  double *v = doubles(n * size, 3);
  for (int64_t i = 0; i < size; i++)
    if (i % 40 < 20)
      for (int64_t t = 1; t < n; t++) p[t * size + i] = p[i], v[t * size + i] = v[i];
  return (frames){n, size, pixels ? p : NULL, pixels ? NULL : v};
}

static void test_projection(void) {
  const int64_t rows[] = {1, 2, 3, 13, 30}, sizes[] = {1, 5, 256, 301, 530}, n[] = {0, 1, 7, 70};
  for (int i = 0; i < 100; i++) {
    int64_t J = rows[i % 5], size = sizes[i / 5 % 5];
    frames x = some_frames(n[i / 25], size, i % 2);
    double *phi = doubles(J * size, 1), *offset = room(J * 8), *y = room(x.n * J * 8);
    mean_output(J, size, phi, doubles(size, 1), offset);
    add_number(outputs(J, phi, offset, &x, y));
    add(y, x.n * J * 8);
    add(offset, J * 8);
  }
  tell("outputs, mean_output");
}

static incsfa new_incsfa(int64_t I, int64_t K, int64_t J) {
  double *v = doubles(K * I, 1), *w = doubles(J * K, 1), *d = room(K * 8);
  for (int64_t k = 0; k < K; k++) d[k] = sqrt(dot(v + k * I, v + k * I, I));
  return (incsfa){.inputs = I, .components = K, .outputs = J, .nu = 0.05, .window = 30,
                  .mean = room(I * 8), .v = v, .d = d, .gram = room(K * K * 8), .w = w,
                  .z_prev = room(K * 8), .phi = room(J * I * 8), .counts = room(3 * 8)};
}

typedef int learning(const incsfa *, const frames *, int, double *);

/* An abstraction of I inputs, K components and J outputs that learns from a few blocks. */
static void learn(learning *update, int64_t I, int64_t K, int64_t J, int pixels) {
  incsfa s = new_incsfa(I, K, J);
  const int64_t n[] = {1, 19, 3, 0, 30};
  for (int i = 0; i < 5; i++) {
    frames x = some_frames(n[i], I, pixels);
    double *xi = room(x.n * 8);
    add_number(update(&s, &x, i == 2, xi));
    add(xi, x.n * 8);
  }
  add(s.mean, I * 8), add(s.v, K * I * 8), add(s.d, K * 8), add(s.gram, K * K * 8);
  add(s.w, J * K * 8), add(s.z_prev, K * 8), add(s.phi, J * I * 8), add(s.counts, 3 * 8);
}

static void test_incsfa(void) {
  learn(incsfa_update, 5, 5, 1, 0);
  learn(incsfa_update, 220, 6, 3, 1);
  tell("incsfa_update");
  learn(incsfa_by_frame, 33, 7, 2, 0);
  learn(incsfa_by_frame, 210, 12, 5, 1);
  tell("incsfa_by_frame");
  learn(incsfa_by_gram, 260, 9, 2, 0);
  learn(incsfa_by_gram, 1043, 20, 3, 1);
  tell("incsfa_by_gram");
}

static void test_recursive(int mixed) {
  enum { I = 300, L = 14, K = 9, J = 4 };
  recursive s = {.inputs = I, .size = L, .components = K - 4 * mixed, .outputs = J, .window = 150,
                 .wide = 12 * mixed, .principal = 2 * mixed,
                 .mean = room(I * 8), .basis = room(L * I * 8), .variance = room(L * 8),
                 .differences = room(L * L * 8), .weights = room(J * L * 8),
                 .spectrum = room(K * 8), .last = room(I * 8), .counts = room(3 * 8)};
  const int64_t n[] = {1, 20, 0, 80, 3};
  for (int i = 0; i < 10; i++) {
    frames x = some_frames(n[i % 5], I, i % 2);
    double *change = room(x.n * 8);
    add_number(recursive_update(&s, &x, i == 3, change));
    add(change, x.n * 8);
  }
  add(s.mean, I * 8), add(s.basis, L * I * 8), add(s.variance, L * 8);
  add(s.differences, L * L * 8), add(s.weights, J * L * 8), add(s.spectrum, K * 8);
  add(s.last, I * 8), add(s.counts, 3 * 8);
  tell(mixed ? "recursive_update, wide" : "recursive_update");
  if (mixed) return;
  for (int64_t n = 1; n < 30; n++) {
    double *matrix = doubles(n * n, 2), *values = room(n * 8), *vectors = room(n * n * 8);
    double *product = room(n * n * 8);
    multiply(n, n, n, matrix, n, matrix, n, product, n);
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < i; j++) matrix[i * n + j] = matrix[j * n + i];
    eigen(n, matrix, values, vectors, room(3 * n * 8));
    add(product, n * n * 8), add(values, n * 8), add(vectors, n * n * 8);
  }
  tell("eigen, multiply");
}

/* A curious agent among streams that repeat, of CD-MISFA 2.0 or 1.0, and two modules that know the
 * first of them. */
static void explore(int tabular) {
  enum { S = 17, J = 2, M = 2, I = 60, TAU = 20, ROWS = 100, PLACES = 4, N = 80 };
  enum { NODE = PLACES * TAU * J, FROZEN = M * S * PLACES };
  rules r = {.sigma = 0.1, .beta = 1, .delta = 0.05, .gamma = 0.9, .epsilon_start = 1,
             .epsilon_decay = 0.99, .epsilon_knee = 0.3, .epsilon_tail_decay = 0.999,
             .slowness_window = 200, .eta_dot_window = 10, .gate_window = 8, .warm_up = 2,
             .min_variance = 1e-6, .novel_share = 0.2, .alpha = 0.1, .roc_radius = 0.5,
             .roc_memory = 20, .roc_error = 0.05, .patience = 1e9, .tabular = tabular};
  outcome out = {0};
  memory m = {.last_stream = -1, .fed_stream = -1, .roc_error = NAN, .xi = NAN, .epsilon = 1};
  agent a = {.streams = S, .outputs = J, .tau = TAU, .tensor = 1, .places = PLACES, .rules = &r,
             .out = &out, .memory = &m, .eta = room(J * 8), .eta_dot = room(J * 8),
             .eta_inst = room(J * 8), .gate_mean = room(J * 8), .gate_variance = room(J * 8),
             .derivative = room(J * 8), .y_sum = room(J * 8), .square_sum = room(J * 8),
             .y_frames = room(8), .recent_mean = room(J * 8), .recent_square = room(J * 8),
             .stay_sum = room(S * 8), .switch_sum = room(S * 8), .dense = room(2 * S * S * 8),
             .policy = room(S * 8), .centres = room(S * NODE * 8), .counts = room(S * PLACES * 8)};
  for (int j = 0; j < J; j++) a.eta_dot[j] = NAN;
  frames x = some_frames(S * ROWS, I, tabular);
  incsfa feature = new_incsfa(I, 6, J);
  double *phi = doubles(M * J * I, 1), *offset = doubles(M * J, 1);
  double *centres = doubles(M * S * NODE, 1);
  frozen f = {.modules = M, .inputs = I, .phi = phi, .offset = offset,
              .band_mean = room(M * J * 8), .band_sd = room(M * J * 8), .centres = centres,
              .counts = room(FROZEN * 8)};
  for (int i = 0; i < M * J; i++) f.band_mean[i] = 0.22, f.band_sd[i] = 0.004;
  for (int i = 0; i < M * PLACES; i++) f.counts[i % PLACES + i / PLACES * S * PLACES] = 1;
  double *uniforms = doubles(3 * N, 1), *Q = room(N * S * 2 * 8), *R = room(N * S * 8);
  for (int i = 0; i < 3 * N; i++) uniforms[i] += 0.5;
  curves kept = {room(N * (int64_t)sizeof(outcome)), room(N * J * 8), R, Q, room(N * S * 8)};
  int64_t done = iterations(&a, &f, &feature, &x, &x, uniforms, N, 0, &kept);
  add_number(done);
  for (int64_t i = 0; i < done; i++) {
    const outcome *o = kept.outcome + i;
    const double all[] = {(double)o->stream, (double)o->known_by, o->saved, o->share, o->roc_error,
                          o->roc_error_inst, o->xi, o->xi_dot, o->curiosity, o->expert, o->reward,
                          o->epsilon, o->explored, (double)o->action, (double)o->next_stream};
    add(all, sizeof all);
  }
  add(kept.eta_dot, N * J * 8), add(Q, N * S * 2 * 8), add(R, N * S * 8);
  add(kept.policy, N * S * 8);
  add(a.eta, J * 8), add(a.gate_mean, J * 8), add(a.gate_variance, J * 8);
  add(a.recent_mean, J * 8), add(a.recent_square, J * 8);
  add(a.dense, 2 * S * S * 8), add(a.centres, S * NODE * 8), add(a.counts, S * PLACES * 8);
  add(feature.phi, J * I * 8);
  double *eta = room(M * J * 8), *y = doubles(M * TAU * J, 1);
  own_work(&a, &f, 5, 1, y, y, eta);
  add(eta, M * J * 8), add(a.eta, J * 8), add(a.dense, 2 * S * S * 8);
  instantaneous_slowness(TAU, J, y, eta);
  add(eta, J * 8);
}

static void test_agent(void) {
  explore(0);
  tell("iterations");
  explore(1);
  tell("iterations of CD-MISFA 1.0");
}

static uint8_t *put(uint8_t *at, uint64_t x, size_t width) {
  memcpy(at, &x, width);
  return at + width;
}

/* A chunk of messages with other bytes here and there, or cut, and values out of its messages. */
static void test_records(void) {
  enum { N = 30, PAYLOAD = 40, SIZE = N * (BEFORE_PAYLOAD + PAYLOAD) };
  uint8_t *sound = bytes(SIZE), *at = sound;
  for (uint64_t i = 0; i < N; i++) {
    at = put(put(put(at, MESSAGE, 1), BEFORE_PAYLOAD - BEFORE_RECORD + PAYLOAD, 8), i % 3, 2);
    at = put(put(put(at, i, 4), 100 + i, 8), 100 + i, 8) + PAYLOAD;
    at[-3] = 7;
  }
  const int64_t far[] = {-1, 0, INT64_MIN, INT64_MAX, INT64_MAX - 7, 1ll << 62};
  const uint8_t heads[] = {0, 1, 5, 7, 16, 128, 255}, marks[] = {7};
  int64_t whole = 0;
  for (int i = 0; i < 600; i++) {
    int64_t size = i < 400 ? SIZE : below(SIZE + 1);
    walked found;
    uint8_t *data = malloc((size_t)size + 1);
    if (!data) abort();
    memcpy(data, sound, (size_t)size);
    if (i % 3 && size) data[below(size)] = heads[below(7)];
    int code = walk_records(data, size, NULL, NULL, &found);
    message *messages = calloc((size_t)found.messages + 1, sizeof *messages);
    int64_t *others = calloc(2 * (size_t)found.others + 1, 8);
    if (!messages || !others) abort();
    if (walk_records(data, size, messages, others, &found) != code) abort();
    if (i % 7 == 6 && found.messages) messages[0].at = far[below(6)];
    if (i % 7 == 5 && found.messages) messages[0].size = far[below(6)];
    int64_t places[] = {i % 11 ? 3 : far[below(6)]}, at_end[] = {PAYLOAD, i % 13 ? 9 : far[below(6)]};
    layout l = {.least = PAYLOAD, .values = 2, .width = 8, .marks = 1, .distances = at_end,
                .places = places, .bytes = marks};
    uint8_t *out = room(N * 16);
    int64_t start = below(4), own = gather(data, size, messages, found.messages, 1, start, 9, &l, out);
    whole += code == 0 && own > 0;
    add_number(code), add(&found, sizeof found), add_number(own);
    add(messages, found.messages * (int64_t)sizeof *messages), add(others, 16 * found.others);
    if (own > start) add(out, (own < 9 ? own - start : 9 - start) * 16);
    free(data), free(messages), free(others);
  }
  if (whole < 100 || whole > 500) abort();
  tell("records");
}

int main(void) {
  test_elementary();
  test_projection();
  test_incsfa();
  test_recursive(0);
  test_agent();
  test_records();
  test_recursive(1);
  return 0;
}
