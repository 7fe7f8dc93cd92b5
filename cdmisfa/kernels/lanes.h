/* Four numbers at a time: the words that every kernel is written in.
 *
 * Sums run over fixed lanes and are added up in a fixed order, and every multiply-add is a fused
 * one, which IEEE 754 rounds once. So the bits are the same whichever compiler, level of
 * optimisation and instruction set made them. Compile with -ffp-contract=off: what is not
 * written as a fused multiply-add must not become one.
 */
#ifndef LANES_H
#define LANES_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#endif

#include "kernels.h"

#define INLINE static inline __attribute__((always_inline))

enum { LANES = 4 };

typedef double lanes __attribute__((vector_size(32), aligned(8), may_alias));

INLINE lanes load(const double *p) { return *(const lanes *)p; }

INLINE void store(double *p, lanes x) { *(lanes *)p = x; }

INLINE lanes spread(double x) { return (lanes){x, x, x, x}; }

/* x y + z, rounded once. */
INLINE lanes add_product(lanes x, lanes y, lanes z) {
#if defined(__AVX2__) && defined(__FMA__)
  return (lanes)_mm256_fmadd_pd((__m256d)x, (__m256d)y, (__m256d)z);
#else
  for (int i = 0; i < LANES; i++) z[i] = fma(x[i], y[i], z[i]);
  return z;
#endif
}

INLINE double sum(lanes x) { return (x[0] + x[2]) + (x[1] + x[3]); }

INLINE int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

INLINE double larger(double a, double b) { return a > b ? a : b; }

int has_wide_lanes(void) {
#if defined(__x86_64__)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
  return 0;
#endif
}

/* x . y over n numbers: sixteen lanes, then four, then what is left in order. */
static double dot(const double *x, const double *y, int64_t n) {
  lanes a = spread(0), b = a, c = a, d = a;
  int64_t i = 0;
  for (; i + 4 * LANES <= n; i += 4 * LANES) {
    a = add_product(load(x + i), load(y + i), a);
    b = add_product(load(x + i + LANES), load(y + i + LANES), b);
    c = add_product(load(x + i + 2 * LANES), load(y + i + 2 * LANES), c);
    d = add_product(load(x + i + 3 * LANES), load(y + i + 3 * LANES), d);
  }
  for (; i + LANES <= n; i += LANES) a = add_product(load(x + i), load(y + i), a);
  double total = sum((a + b) + (c + d));
  for (; i < n; i++) total = fma(x[i], y[i], total);
  return total;
}

/* y += a x. */
INLINE void add_multiple(double a, const double *x, double *y, int64_t n) {
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) store(y + i, add_product(spread(a), load(x + i), load(y + i)));
  for (; i < n; i++) y[i] = fma(a, x[i], y[i]);
}

/* Some rows of v times some rows of u; both counts are constants where this is called. */
INLINE void add_products_of(int rows, int frames, const double *v, int64_t v_row, const double *u,
                            int64_t u_row, int64_t width, double *e, int64_t e_row) {
  lanes s[3][8];
  int64_t whole = width - width % LANES;
#pragma GCC unroll 3
  for (int r = 0; r < rows; r++)
#pragma GCC unroll 8
    for (int t = 0; t < frames; t++) s[r][t] = spread(0);
  for (int64_t i = 0; i < whole; i += LANES) {
#pragma GCC unroll 8
    for (int t = 0; t < frames; t++) {
      lanes x = load(u + t * u_row + i);
#pragma GCC unroll 3
      for (int r = 0; r < rows; r++) s[r][t] = add_product(load(v + r * v_row + i), x, s[r][t]);
    }
  }
#pragma GCC unroll 3
  for (int r = 0; r < rows; r++)
#pragma GCC unroll 8
    for (int t = 0; t < frames; t++) {
      double total = sum(s[r][t]);
      for (int64_t i = whole; i < width; i++)
        total = fma(v[r * v_row + i], u[t * u_row + i], total);
      e[r * e_row + t] += total;
    }
}

/* e[r][t] += v[r] . u[t] for all rows of v and of u: what every kernel spends most on.
 *
 * Each sum has four lanes of its own, whichever rows are taken together to keep both in
 * registers: it does not depend on what it is stacked with.
 */
static void add_products(int64_t rows, int64_t frames, const double *v, int64_t v_row,
                         const double *u, int64_t u_row, int64_t width, double *e, int64_t e_row) {
  int64_t t = 0;
  if (rows < 3)
    for (; t + 8 <= frames; t += 8)
      for (int64_t r = 0; r < rows; r++)
        add_products_of(1, 8, v + r * v_row, v_row, u + t * u_row, u_row, width,
                        e + r * e_row + t, e_row);
  for (; t + 4 <= frames; t += 4) {
    int64_t r = 0;
    for (; r + 3 <= rows; r += 3)
      add_products_of(3, 4, v + r * v_row, v_row, u + t * u_row, u_row, width,
                      e + r * e_row + t, e_row);
    if (r + 2 == rows)
      add_products_of(2, 4, v + r * v_row, v_row, u + t * u_row, u_row, width,
                      e + r * e_row + t, e_row);
    if (r + 1 == rows)
      add_products_of(1, 4, v + r * v_row, v_row, u + t * u_row, u_row, width,
                      e + r * e_row + t, e_row);
  }
  for (; t < frames; t++) {
    int64_t r = 0;
    for (; r + 3 <= rows; r += 3)
      add_products_of(3, 1, v + r * v_row, v_row, u + t * u_row, u_row, width,
                      e + r * e_row + t, e_row);
    for (; r < rows; r++)
      add_products_of(1, 1, v + r * v_row, v_row, u + t * u_row, u_row, width,
                      e + r * e_row + t, e_row);
  }
}

#endif
