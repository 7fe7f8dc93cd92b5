/* Eigenvectors of small symmetric matrices: Householder reduction to a tridiagonal matrix, then the
 * implicit QL method. Reflectors and vectors are rows, so that inner loops run along memory.
 *
 * Source: Golub and Van Loan, Matrix Computations, 8.3.
 */

enum { QL_STEPS = 60 }; /* limit for one eigenvalue, which takes two or three */

static const double LAST_BIT = 2.3e-16;

/* Householder reduction to diagonal and off-diagonal; reflectors replace the rows of a. */
static void reduce(int64_t n, double *a, double *values, double *beside, double *factors,
                   double *q) {
  for (int64_t k = 0; k < n; k++) {
    int64_t rest = n - k - 1;
    double *h = a + k * n + k + 1, *inner = h + n, largest = 0;
    values[k] = a[k * n + k];
    if (rest == 1) beside[k] = h[0];
    for (int64_t i = 0; i < rest; i++) largest = larger(fabs(h[i]), largest);
    if (rest < 2 || largest == 0) continue;
    for (int64_t i = 0; i < rest; i++) h[i] /= largest;
    double square = dot(h, h, rest), length = h[0] > 0 ? -sqrt(square) : sqrt(square);
    factors[k] = 1 / (square - h[0] * length);
    beside[k] = length * largest;
    h[0] -= length;
    memset(q, 0, (size_t)rest * sizeof *q);
    add_products(1, rest, h, n, inner, n, rest, q, n);
    for (int64_t i = 0; i < rest; i++) q[i] *= factors[k];
    add_multiple(-0.5 * factors[k] * dot(q, h, rest), h, q, rest);
    for (int64_t i = 0; i < rest; i++)
      for (int64_t j = 0; j < rest; j++) inner[i * n + j] -= h[i] * q[j] + q[i] * h[j];
  }
}

/* One implicit QL step from `first` on; 0 if that eigenvalue is separated already. */
static int ql_step(int64_t n, int64_t first, double *values, double *beside, double *vectors) {
  int64_t last = first;
  while (last < n - 1 &&
         !(fabs(beside[last]) <= LAST_BIT * (fabs(values[last]) + fabs(values[last + 1]))))
    last++;
  if (last == first) return 0;
  double g = (values[first + 1] - values[first]) / (2 * beside[first]);
  double r = sqrt(g * g + 1), s = 1, c = 1, p = 0;
  g = values[last] - values[first] + beside[first] / (g + (g >= 0 ? r : -r));
  for (int64_t i = last - 1; i >= first; i--) {
    double f = s * beside[i], b = c * beside[i];
    double *below = vectors + i * n, *above = below + n;
    beside[i + 1] = r = sqrt(f * f + g * g);
    if (r == 0) {
      values[i + 1] -= p;
      beside[last] = 0;
      return 1;
    }
    s = f / r;
    c = g / r;
    g = values[i + 1] - p;
    r = (values[i] - g) * s + 2 * c * b;
    p = s * r;
    values[i + 1] = g + p;
    g = c * r - b;
    for (int64_t j = 0; j < n; j++) {
      double x = above[j], y = below[j];
      above[j] = s * y + c * x;
      below[j] = c * y - s * x;
    }
  }
  values[first] -= p;
  beside[first] = g;
  beside[last] = 0;
  return 1;
}

/* Eigenvalues (n,), the largest first, and eigenvectors (n, n), one in each row, of a symmetric
 * matrix, which is overwritten; `spare` has 3 n numbers.
 */
void eigen(int64_t n, double *matrix, double *values, double *vectors, double *spare) {
  double *beside = take_zeros(&spare, n), *factors = take_zeros(&spare, n);
  reduce(n, matrix, values, beside, factors, spare);
  for (int64_t i = 0; i < n * n; i++) vectors[i] = i % (n + 1) == 0;
  for (int64_t k = n - 3; k >= 0; k--) {
    const double *h = matrix + k * n + k + 1;
    if (factors[k] == 0) continue;
    for (int64_t i = k + 1; i < n; i++) {
      double *row = vectors + i * n + k + 1;
      add_multiple(-factors[k] * dot(h, row, n - k - 1), h, row, n - k - 1);
    }
  }
  for (int64_t k = 0; k < n; k++)
    for (int i = 0; i < QL_STEPS && ql_step(n, k, values, beside, vectors); i++) continue;
  for (int64_t i = 0; i < n; i++) {
    int64_t k = i;
    for (int64_t j = i + 1; j < n; j++)
      if (values[j] > values[k]) k = j;
    if (k == i) continue;
    double value = values[i];
    values[i] = values[k];
    values[k] = value;
    copy(vectors + i * n, spare, n);
    copy(vectors + k * n, vectors + i * n, n);
    copy(spare, vectors + k * n, n);
  }
}
