/* Vectors of four doubles ("lanes"), in which all kernels are written.
 *
 * Sums run over fixed lanes and are added in a fixed order, and every multiply-add is a fused one,
 * which IEEE 754 rounds once. Therefore the bits do not depend on compiler, optimisation or
 * instruction set. Compile with -ffp-contract=off: other products and sums must not be fused.
 */
#ifndef LANES_H
#define LANES_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__x86_64__)
#include <cpuid.h>
#endif
#if defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#endif

#include "kernels.h"

#define INLINE static inline __attribute__((always_inline))

enum { LANES = 4 };

typedef double lanes __attribute__((vector_size(32), aligned(8), may_alias));

/* Four whole numbers, or the result of a comparison of lanes: all bits or none. */
typedef int64_t whole_lanes __attribute__((vector_size(32), aligned(8), may_alias));

INLINE lanes load(const double *p) { return *(const lanes *)p; }

INLINE void store(double *p, lanes x) { *(lanes *)p = x; }

INLINE lanes spread(double x) { return (lanes){x, x, x, x}; }

INLINE whole_lanes load_whole(const int64_t *p) { return *(const whole_lanes *)p; }

/* x where a comparison is true, else y. */
INLINE lanes choose(whole_lanes holds, lanes x, lanes y) {
  return (lanes)(((whole_lanes)x & holds) | ((whole_lanes)y & ~holds));
}

INLINE lanes absolute(lanes x) { return (lanes)((whole_lanes)x & INT64_MAX); }

#if !(defined(__AVX2__) && defined(__FMA__)) && !defined(__aarch64__)

typedef double pair __attribute__((vector_size(16)));
typedef int64_t bits __attribute__((vector_size(16)));

/* x + y; `lost` receives the rounding error. */
INLINE pair two_sum(pair x, pair y, pair *lost) {
  pair total = x + y, rest = total - x;
  *lost = (x - (total - rest)) + (y - rest);
  return total;
}

/* The first 26 bits of x. */
INLINE pair upper_half(pair x) {
  pair shifted = x * 134217729.0;
  return shifted - (shifted - x);
}

INLINE bits between(pair x, double low, double high) {
  pair size = (pair)((bits)x & INT64_MAX);
  return (bits)(size >= low) & (bits)(size <= high);
}

/* x y + z, rounded once, for processors without an instruction for it.
 *
 * Product and sums are split into rounded values and rounding errors, whose sum is rounded to odd,
 * so that the last addition rounds as the exact sum would: Boldo and Melquiond (2008). The C
 * library's fma computes values that are too large or too small for this.
 */
INLINE pair add_product_of_pair(pair x, pair y, pair z) {
  bits zero = (bits)(x == 0) | (bits)(y == 0);
  bits fits = between(x, 0x1p-450, 0x1p450) & between(y, 0x1p-450, 0x1p450);
  fits = (fits & between(z, 0, 0x1p900)) | zero;
  if (!(fits[0] & fits[1])) return (pair){fma(x[0], y[0], z[0]), fma(x[1], y[1], z[1])};
  pair p = x * y, a = upper_half(x), b = upper_half(y), c = x - a, d = y - b, lost, last, odd;
  pair error = ((a * b - p) + a * d + c * b) + c * d;
  pair high = two_sum(p, two_sum(z, error, &lost), &last), low = two_sum(lost, last, &odd);
  bits away = ((bits)(odd > 0) ^ (bits)(low > 0)) | 1, even = ((bits)low & 1) - 1;
  low = (pair)((bits)low + (away & even & (bits)(odd != 0)));
  return (pair)(((bits)(p + z) & zero) | ((bits)(high + low) & ~zero));
}

#endif

/* x y + z, rounded once. */
INLINE lanes add_product(lanes x, lanes y, lanes z) {
#if defined(__AVX2__) && defined(__FMA__)
  return (lanes)_mm256_fmadd_pd((__m256d)x, (__m256d)y, (__m256d)z);
#elif defined(__aarch64__)
  for (int i = 0; i < LANES; i++) z[i] = __builtin_fma(x[i], y[i], z[i]);
  return z;
#else
  pair low = add_product_of_pair((pair){x[0], x[1]}, (pair){y[0], y[1]}, (pair){z[0], z[1]});
  pair high = add_product_of_pair((pair){x[2], x[3]}, (pair){y[2], y[3]}, (pair){z[2], z[3]});
  return (lanes){low[0], low[1], high[0], high[1]};
#endif
}

/* x y + z of single numbers, rounded once. */
INLINE double fused(double x, double y, double z) {
#if defined(__FMA__) || defined(__aarch64__)
  return __builtin_fma(x, y, z);
#else
  return add_product_of_pair((pair){x, x}, (pair){y, y}, (pair){z, z})[0];
#endif
}

INLINE double sum(lanes x) { return (x[0] + x[2]) + (x[1] + x[3]); }

INLINE int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

INLINE double larger(double a, double b) { return a > b ? a : b; }

/* __builtin_cpu_supports returns 0 with zig's run-time library for clang, so it is not used. */
int has_wide_lanes(void) {
#if defined(__x86_64__)
  const unsigned needed = bit_FMA | bit_AVX | bit_OSXSAVE, kept_by_system = 6;
  unsigned a, b, c, d, state, high;
  if (!__get_cpuid(1, &a, &b, &c, &d) || (c & needed) != needed) return 0;
  __asm__("xgetbv" : "=a"(state), "=d"(high) : "c"(0));
  if ((state & kept_by_system) != kept_by_system) return 0;
  return __get_cpuid_count(7, 0, &a, &b, &c, &d) && (b & bit_AVX2);
#else
  return 0;
#endif
}

/* x . y over many numbers: sixteen lanes, then four, then the rest in order. */
static double long_dot(const double *x, const double *y, int64_t n) {
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
  for (; i < n; i++) total = fused(x[i], y[i], total);
  return total;
}

/* x . y; a few numbers are added in order, which is faster than adding lanes. */
INLINE double dot(const double *x, const double *y, int64_t n) {
  if (n >= 2 * LANES) return long_dot(x, y, n);
  double even = 0, odd = 0;
  for (int64_t i = 0; i < n - 1; i += 2) {
    even = fused(x[i], y[i], even);
    odd = fused(x[i + 1], y[i + 1], odd);
  }
  return (n % 2 ? fused(x[n - 1], y[n - 1], even) : even) + odd;
}

/* y += a x. */
INLINE void add_multiple(double a, const double *x, double *y, int64_t n) {
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) store(y + i, add_product(spread(a), load(x + i), load(y + i)));
  for (; i < n; i++) y[i] = fused(a, x[i], y[i]);
}

/* |x - y|^2, see `dot`. */
static double square_distance(const double *x, const double *y, int64_t n) {
  lanes a = spread(0), b = a;
  int64_t i = 0;
  for (; i + 2 * LANES <= n; i += 2 * LANES) {
    lanes c = load(x + i) - load(y + i), d = load(x + i + LANES) - load(y + i + LANES);
    a = add_product(c, c, a);
    b = add_product(d, d, b);
  }
  double total = sum(a + b);
  for (; i < n; i++) total = fused(x[i] - y[i], x[i] - y[i], total);
  return total;
}

static const double PIXEL = 1.0 / 255;

/* Four pixels as values. */
INLINE lanes read_pixels(const uint8_t *p) {
#if defined(__AVX2__) && defined(__FMA__)
  int32_t four;
  memcpy(&four, p, sizeof four);
  return (lanes)_mm256_cvtepi32_pd(_mm_cvtepu8_epi32(_mm_cvtsi32_si128(four))) * spread(PIXEL);
#else
  return (lanes){p[0], p[1], p[2], p[3]} * spread(PIXEL);
#endif
}

/* Four values of frames from index `at` on; `pixels` is a constant at each call. */
INLINE lanes read_lanes(const frames *x, int pixels, int64_t at) {
  return pixels ? read_pixels(x->pixels + at) : load(x->values + at);
}

INLINE double read_value(const frames *x, int64_t at) {
  return x->pixels ? x->pixels[at] * PIXEL : x->values[at];
}

/* Write columns [start, start + width) of frame t as values. */
static void read_columns(const frames *x, int64_t t, int64_t start, int64_t width, double *out) {
  int64_t at = t * x->size + start, i = 0;
  if (x->values) {
    memcpy(out, x->values + at, (size_t)width * sizeof *out);
    return;
  }
  for (; i + LANES <= width; i += LANES) store(out + i, read_pixels(x->pixels + at + i));
  for (; i < width; i++) out[i] = x->pixels[at + i] * PIXEL;
}

/* Add products of some rows of v with some rows of u, or with pixels; both counts are constants at
 * each call, and one of the two pointers is null. */
INLINE void add_products_of(int rows, int frames, const double *v, int64_t v_row, const double *u,
                            const uint8_t *pixels, int64_t u_row, int64_t width, double *e,
                            int64_t e_row) {
  lanes s[3][8];
  int64_t whole = width - width % LANES;
#pragma GCC unroll 3
  for (int r = 0; r < rows; r++)
#pragma GCC unroll 8
    for (int t = 0; t < frames; t++) s[r][t] = spread(0);
  for (int64_t i = 0; i < whole; i += LANES) {
#pragma GCC unroll 8
    for (int t = 0; t < frames; t++) {
      lanes x = pixels ? read_pixels(pixels + t * u_row + i) : load(u + t * u_row + i);
#pragma GCC unroll 3
      for (int r = 0; r < rows; r++) s[r][t] = add_product(load(v + r * v_row + i), x, s[r][t]);
    }
  }
#pragma GCC unroll 3
  for (int r = 0; r < rows; r++)
#pragma GCC unroll 8
    for (int t = 0; t < frames; t++) {
      double total = sum(s[r][t]);
      for (int64_t i = whole; i < width; i++) {
        double x = pixels ? pixels[t * u_row + i] * PIXEL : u[t * u_row + i];
        total = fused(v[r * v_row + i], x, total);
      }
      e[r * e_row + t] += total;
    }
}

/* e[r][t] += v[r] . u[t] for all rows of v and of u. The kernels spend most of their time here.
 *
 * Each sum has four lanes of its own, whatever rows are computed together to keep both in
 * registers, so that a sum does not depend on the other rows.
 */
static void add_products(int64_t rows, int64_t frames, const double *v, int64_t v_row,
                         const double *u, int64_t u_row, int64_t width, double *e, int64_t e_row) {
  int64_t t = 0;
  if (rows < 3)
    for (; t + 8 <= frames; t += 8)
      for (int64_t r = 0; r < rows; r++)
        add_products_of(1, 8, v + r * v_row, v_row, u + t * u_row, NULL, u_row, width,
                        e + r * e_row + t, e_row);
  for (; t + 4 <= frames; t += 4) {
    int64_t r = 0;
    for (; r + 3 <= rows; r += 3)
      add_products_of(3, 4, v + r * v_row, v_row, u + t * u_row, NULL, u_row, width,
                      e + r * e_row + t, e_row);
    if (r + 2 == rows)
      add_products_of(2, 4, v + r * v_row, v_row, u + t * u_row, NULL, u_row, width,
                      e + r * e_row + t, e_row);
    if (r + 1 == rows)
      add_products_of(1, 4, v + r * v_row, v_row, u + t * u_row, NULL, u_row, width,
                      e + r * e_row + t, e_row);
  }
  for (; t < frames; t++) {
    int64_t r = 0;
    for (; r + 3 <= rows; r += 3)
      add_products_of(3, 1, v + r * v_row, v_row, u + t * u_row, NULL, u_row, width,
                      e + r * e_row + t, e_row);
    for (; r < rows; r++)
      add_products_of(1, 1, v + r * v_row, v_row, u + t * u_row, NULL, u_row, width,
                      e + r * e_row + t, e_row);
  }
}

/* Some rows of `add_multiplied` over 4 `blocks` columns; both are constants at each call. */
INLINE void multiply_block(int rows, int blocks, int64_t parts, const double *a, int64_t a_row,
                           const double *b, int64_t b_row, double *c, int64_t c_row) {
  lanes s[3][4];
#pragma GCC unroll 3
  for (int r = 0; r < rows; r++)
#pragma GCC unroll 4
    for (int i = 0; i < blocks; i++) s[r][i] = load(c + r * c_row + i * LANES);
  for (int64_t p = 0; p < parts; p++)
#pragma GCC unroll 4
    for (int i = 0; i < blocks; i++) {
      lanes x = load(b + p * b_row + i * LANES);
#pragma GCC unroll 3
      for (int r = 0; r < rows; r++) s[r][i] = add_product(spread(a[r * a_row + p]), x, s[r][i]);
    }
#pragma GCC unroll 3
  for (int r = 0; r < rows; r++)
#pragma GCC unroll 4
    for (int i = 0; i < blocks; i++) store(c + r * c_row + i * LANES, s[r][i]);
}

/* All rows of `add_multiplied` over 4 `blocks` columns. */
INLINE void multiply_columns(int blocks, int64_t rows, int64_t parts, const double *a,
                             int64_t a_row, const double *b, int64_t b_row, double *c,
                             int64_t c_row) {
  int64_t r = 0;
  for (; r + 3 <= rows; r += 3)
    multiply_block(3, blocks, parts, a + r * a_row, a_row, b, b_row, c + r * c_row, c_row);
  if (r + 2 == rows)
    multiply_block(2, blocks, parts, a + r * a_row, a_row, b, b_row, c + r * c_row, c_row);
  if (r + 1 == rows)
    multiply_block(1, blocks, parts, a + r * a_row, a_row, b, b_row, c + r * c_row, c_row);
}

/* c += a b; see `multiply`. */
static void add_multiplied(int64_t rows, int64_t parts, int64_t width, const double *a,
                           int64_t a_row, const double *b, int64_t b_row, double *c,
                           int64_t c_row) {
  int64_t j = 0;
  for (; j + 4 * LANES <= width; j += 4 * LANES)
    multiply_columns(4, rows, parts, a, a_row, b + j, b_row, c + j, c_row);
  for (; j + LANES <= width; j += LANES)
    multiply_columns(1, rows, parts, a, a_row, b + j, b_row, c + j, c_row);
  for (; j < width; j++)
    for (int64_t r = 0; r < rows; r++) {
      double total = c[r * c_row + j];
      for (int64_t p = 0; p < parts; p++) total = fused(a[r * a_row + p], b[p * b_row + j], total);
      c[r * c_row + j] = total;
    }
}

/* c = a b, of (rows, parts) and (parts, width); sums are in the order of the parts. */
void multiply(int64_t rows, int64_t parts, int64_t width, const double *a, int64_t a_row,
              const double *b, int64_t b_row, double *c, int64_t c_row) {
  for (int64_t r = 0; r < rows; r++) memset(c + r * c_row, 0, (size_t)width * sizeof *c);
  add_multiplied(rows, parts, width, a, a_row, b, b_row, c, c_row);
}

/* Take n numbers from the scratch memory. */
static double *take(double **spare, int64_t n) {
  double *taken = *spare;
  *spare += n;
  return taken;
}

/* Take n numbers from the scratch memory, set to 0. */
static double *take_zeros(double **spare, int64_t n) {
  double *taken = take(spare, n);
  return memset(taken, 0, (size_t)n * sizeof *taken);
}

static void copy(const double *x, double *y, int64_t n) { memcpy(y, x, (size_t)n * sizeof *y); }

#endif
