/* exp, log, sine, cosine and normal draws from additions, multiplications and divisions only.
 *
 * Functions of C libraries are as exact, but their last bit depends on library and processor.
 */

static const double LN_2 = 0.693147180559945309417;
/* ln 2 in two parts: the first has 33 bits, so that its products with exponents are exact. */
static const double LN_2_HIGH = 6.93147180369123816490e-01, LN_2_LOW = 1.90821492927058770002e-10;
/* pi / 2 in three parts: the first two have 33 bits. */
static const double HALF_PI[3] = {1.57079632673412561417, 6.07710050630396597660e-11,
                                  2.02226624879595063154e-21};

static double from_bits(uint64_t bits) {
  double x;
  memcpy(&x, &bits, sizeof x);
  return x;
}

static uint64_t to_bits(double x) {
  uint64_t bits;
  memcpy(&bits, &x, sizeof bits);
  return bits;
}

/* 2^k for -1022 <= k <= 1023. */
static double power_of_two(int64_t k) { return from_bits((uint64_t)(k + 1023) << 52); }

/* Series of exp around the nearest power of two; the next term is below half a bit. */
double exp_of(double x) {
  if (!(x >= -745.2)) return x < 0 ? 0.0 : NAN;
  if (x > 709.8) return INFINITY;
  int64_t halvings = (int64_t)floor(fused(x, 1.0 / LN_2, 0.5));
  double rest = fused(-(double)halvings, LN_2_LOW, fused(-(double)halvings, LN_2_HIGH, x));
  double total = 1.0;
  for (int n = 14; n > 0; n--) total = fused(rest * total, 1.0 / n, 1.0);
  return total * power_of_two(halvings / 2) * power_of_two(halvings - halvings / 2);
}

/* Series of artanh: log m = 2 artanh((m - 1) / (m + 1)) for m between sqrt(1/2) and sqrt(2). */
double log_of(double x) {
  if (!(x > 0)) return x == 0 ? -INFINITY : NAN;
  if (x == INFINITY) return x;
  int64_t exponent = 0;
  if (x < power_of_two(-1022)) {
    x *= power_of_two(54);
    exponent = -54;
  }
  uint64_t bits = to_bits(x);
  exponent += (int64_t)(bits >> 52) - 1022;
  double m = from_bits((bits & 0x000fffffffffffffull) | 0x3fe0000000000000ull);
  if (m < 0.707106781186547524401) {
    m *= 2;
    exponent--;
  }
  double ratio = (m - 1) / (m + 1), square = ratio * ratio, total = 0;
  for (int n = 12; n > 0; n--) total = (total + 1.0 / (2 * n + 1)) * square;
  double small = fused(2 * ratio, total, (double)exponent * LN_2_LOW);
  return fused((double)exponent, LN_2_HIGH, 2 * ratio + small);
}

/* Sine of x + `ahead` quarter turns, by the series of sine or cosine within an eighth of a turn. */
static double sine(double x, int ahead) {
  double turns = floor(fused(x, 1.0 / (HALF_PI[0] + HALF_PI[1]), 0.5));
  double rest = fused(-turns, HALF_PI[2], fused(-turns, HALF_PI[1], fused(-turns, HALF_PI[0], x)));
  double square = rest * rest, sine = 1, cosine = 1;
  for (int n = 10; n > 0; n--) {
    sine = fused(-square * sine, 1.0 / ((2 * n) * (2 * n + 1)), 1);
    cosine = fused(-square * cosine, 1.0 / ((2 * n - 1) * (2 * n)), 1);
  }
  int quarter = (int)(turns - 4 * floor(turns / 4)) + ahead;
  double y = quarter % 2 == 0 ? rest * sine : cosine;
  return quarter % 4 < 2 ? y : -y;
}

/* Sines of n numbers of at most a million; the results for larger numbers are undefined. */
void sines(const double *x, int64_t n, double *out) {
  for (int64_t i = 0; i < n; i++) out[i] = fabs(x[i]) < 1e9 ? sine(x[i], 0) : NAN;
}

void cosines(const double *x, int64_t n, double *out) {
  for (int64_t i = 0; i < n; i++) out[i] = fabs(x[i]) < 1e9 ? sine(x[i], 1) : NAN;
}

/* Standard normal draws from the words of a bit generator, by the ziggurat of Marsaglia and Tsang
 * (2000) with 256 layers. Words are used in the order of numpy's Generator: the draws equal those
 * of `standard_normal` up to the rounding of its tail.
 *
 * Returns the number of words used, or -1 if there are too few.
 */
int64_t normals(const uint64_t *words, int64_t n_words, double *out, int64_t n) {
  const double edge = 3.6541528853610088, area = 0.00492867323397465524494;
  double right[256], height[256], inside[256]; /* of each layer; its share under the next layer */
  right[255] = edge;
  height[0] = 1;
  height[255] = exp_of(-0.5 * edge * edge);
  right[0] = area / height[255];
  inside[0] = edge / right[0];
  inside[1] = 0;
  for (int i = 254; i > 0; i--) {
    right[i] = sqrt(-2 * log_of(area / right[i + 1] + height[i + 1]));
    height[i] = exp_of(-0.5 * right[i] * right[i]);
    inside[i + 1] = right[i] / right[i + 1];
  }
  int64_t used = 0;
  for (int64_t i = 0; i < n;) {
    if (used == n_words) return -1;
    uint64_t word = words[used++], layer = word & 255, bits = (word >> 9) & 0x000fffffffffffffull;
    double share = (double)bits * power_of_two(-52), x = share * right[layer];
    int negative = (word >> 8) & 1;
    if (share >= inside[layer]) {
      if (layer > 0) {
        if (used == n_words) return -1;
        double u = (double)(words[used++] >> 11) * power_of_two(-53);
        double between = fused(height[layer - 1] - height[layer], u, height[layer]);
        if (between >= exp_of(-0.5 * x * x)) continue;
      } else {
        double beyond, y;
        do {
          if (used + 2 > n_words) return -1;
          beyond = -log_of(1 - (double)(words[used] >> 11) * power_of_two(-53)) / edge;
          y = -log_of(1 - (double)(words[used + 1] >> 11) * power_of_two(-53));
          used += 2;
        } while (y + y <= beyond * beyond);
        x = edge + beyond;
        negative = (bits >> 8) & 1;
      }
    }
    out[i++] = negative ? -x : x;
  }
  return used;
}
