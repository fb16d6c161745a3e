#include "../core/step.h"

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-tree-slp-vectorize") /* its vectors wait for stores of single numbers: a seventh of the time */
#endif

/* Free rotation of a rigid body with quaternion q, its momentum p, and Pi = E(q)^T p/2 in the body frame, exact to
 * round-off:
 *   T = (a_1 Pi_1^2 + a_2 Pi_2^2 + a_3 Pi_3^2)/2,   q <- q g,   p <- p g,   |g| = 1.
 * Two equal moments, a_i = a_j: rotations about the angular momentum and a body axis (E. J. Routh, Advanced Rigid
 * Dynamics). Three different ones: Jacobi's elliptic functions (E. Celledoni, F. Fasso, N. Saefstroem, A. Zanna, SIAM
 * J. Sci. Comput. 30 (2008), 2084-2112; R. van Zon, J. Schofield, J. Comput. Phys. 225 (2007), 145-164). */

#define OVER(n) (1 / (real)(n)) /* reciprocal of a factorial */

/* Computes cos(x) - 1 and sin(x)/x from x^2, by their series for small x. */
static inline void half_turn(real x2, real *cosine, real *sine)
{
  if (x2 < (real)0.25) {
    const real x4 = x2 * x2, x8 = x4 * x4;
    *cosine = -x2 * (OVER(2) - x2 * OVER(24) + x4 * (OVER(720) - x2 * OVER(40320)));
    *cosine -= x2 * x8 * (OVER(3628800) - x2 * OVER(479001600) + x4 * OVER(87178291200));
    *sine = 1 - x2 * OVER(6) + x4 * (OVER(120) - x2 * OVER(5040));
    *sine += x8 * (OVER(362880) - x2 * OVER(39916800) + x4 * (OVER(6227020800) - x2 * OVER(1307674368000)));
  } else {
    const real x = MATH(sqrt)(x2), half = MATH(sin)(x / 2);
    *cosine = -2 * half * half;
    *sine = MATH(sin)(x) / x;
  }
}

/* Computes a b for quaternions. */
static inline void multiply(const real *restrict a, const real *restrict b, real *restrict product)
{
  product[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  product[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  product[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  product[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

/* Axes l, m, s of a body in cyclic order with a_m between a_l and a_s, and differences ls = a_l - a_s, ms = a_m - a_s,
 * lm = a_l - a_m, which is 0 if two moments are equal. */
typedef struct {
  int l, m, s;
  real a_m, a_s, ls, ms, lm;
} free_body;

/* Sorts the axes, from the axes j and k and a_i, a_j - a_i, a_k - a_i; a_i = a_j are those of l and m. */
static inline free_body sorted_axes(const int *axes, const real *rates)
{
  real a[3] = {rates[0], rates[0], rates[0]};
  a[axes[0]] += rates[1];
  a[axes[1]] += rates[2];
  const int low = a[0] < a[1], end = low == (a[2] < a[0]) ? 0 : 2, middle = low == (a[1] < a[2]) ? 1 : end;
  const int m = rates[1] == 0 ? (axes[1] + 2) % 3 : middle, l = (m + 2) % 3, s = (m + 1) % 3;
  return (free_body){l, m, s, a[m], a[s], a[l] - a[s], a[m] - a[s], a[l] - a[m]};
}

/* Computes g with 1 + g = exp(t a_m Pi/2) exp(t (a_s - a_m) Pi_s e_s/2) for a_l = a_m and a constant s. */
static inline void turn_symmetric(int s, const free_body *body, real t, const real *restrict Pi, real *restrict g)
{
  const real about = -t * body->ms * Pi[s] / 2;
  real r[4] = {0}, product[4], x2 = 0, sine;
  for (int i = 0; i < 3; i++) {
    g[1 + i] = t * body->a_m * Pi[i] / 2;
    x2 += g[1 + i] * g[1 + i];
  }
  half_turn(x2, g, &sine);
  for (int i = 1; i < 4; i++)
    g[i] *= sine;
  half_turn(about * about, r, &sine);
  r[1 + s] = sine * about;
  multiply(g, r, product);
  for (int i = 0; i < 4; i++)
    g[i] += r[i] + product[i];
}

/* Functions of the time t, which solve
 *   sigma' = cn dn,   cn^2 = 1 - A sigma^2,   dn^2 = 1 - B sigma^2,   Theta' = Q sigma^2/(1 + N sigma^2),
 *   Q = sqrt(N (N + A) (N + B)),   A, B, N >= 0,
 * with sigma = Theta = 0 at t = 0: Jacobi's functions sn/lambda, cn and dn, and an elliptic integral of the third kind,
 * of which a multiple of exp(i Theta) = cosine + i sine is needed. */
typedef struct {
  real sigma, cn, dn, cosine, sine;
} elliptic;

/* Computes sigma, cn, dn, and Theta/Q as sine, by Taylor series for A t^2, (B + N) t^2 < 2^-12. */
static inline elliptic elliptic_by_series(real t, real A, real B, real N)
{
  const real t2 = t * t, p = (A + B) * t2, q = A * B * t2 * t2, r = N * t2, p2 = p * p;
  const real sigma = t * (1 - p / 6 + (p2 + 12 * q) / 120 - p * (p2 + 132 * q) / 5040);
  const real x = A * sigma * sigma, y = B * sigma * sigma, fourth = 2 * p2 / 45 + q / 5 + r * (2 * p / 3 + r);
  const real sixth = p2 * p / 315 + 3 * p * q / 35 + r * ((p2 + 2 * q) / 5 + r * (p + r));
  return (elliptic){.sigma = sigma,
      .cn = 1 - x * (OVER(2) + x * (OVER(8) + x * (OVER(16) + x * (5 * OVER(128))))),
      .dn = 1 - y * (OVER(2) + y * (OVER(8) + y * (OVER(16) + y * (5 * OVER(128))))),
      .cosine = 1,
      .sine = t * t2 * (OVER(3) - (p / 3 + r) / 5 + fourth / 7 - sixth / 9)};
}

/* Multiplies exp(i Theta) by x + i y. */
static inline void turn_phase(elliptic *at, real x, real y)
{
  const real cosine = at->cosine;
  at->cosine = cosine * x - at->sine * y;
  at->sine = cosine * y + at->sine * x;
}

/* Computes them by series at t/2^n and n times the formulas for twice the argument,
 *   sigma <- 2 sigma cn dn/(1 - A B sigma^4), .., Theta <- 2 Theta + arg(1 + N (sigma_2^2 - sigma^2 cn_2 dn_2)
 *     + i Q sigma^2 sigma_2),   where the index 2 denotes values at twice the argument. */
static inline elliptic elliptic_by_doubling(real t, int n, real A, real B, real N, real Q)
{
  elliptic at = elliptic_by_series(t / (1 << n), A, B, N);
  at.sine *= Q;
  at.cosine -= at.sine * at.sine / 2;
  for (; n > 0; n--) {
    const real u = at.sigma * at.sigma, k = A * B * u * u, over = 1 / (1 - k);
    at.sigma *= 2 * at.cn * at.dn * over;
    at.cn = (1 + k - 2 * A * u) * over;
    at.dn = (1 + k - 2 * B * u) * over;
    turn_phase(&at, at.cosine, at.sine);
    turn_phase(&at, 1 + N * (at.sigma * at.sigma - u * at.cn * at.dn), Q * u * at.sigma);
  }
  return at;
}

enum { LANDEN_STEPS = 24 };

/* Computes them by descending Landen transformations, with a_0^2 = max(A, B), b_0^2 = D = |A - B|, c_0^2 = min(A, B),
 * n_0^2 = N, the arithmetic-geometric mean, and y = c_k a_k sigma_k^2:
 *   sigma_{k-1} = sigma_k/(1 + y),  cn_{k-1} = cn_k dn_k/(1 + y),  dn_{k-1} = (cn_k^2 + b_{k-1} a_k sigma_k^2)/(1 + y),
 *   n_k = c_{k-1}^2/(2 (n_{k-1} + sqrt(n_{k-1}^2 + c_{k-1}^2))),   r_k^2 = a_{k-1}^2 + n_{k-1}^2,
 *   Theta_{k-1} = r_k t - arg(cn_k dn_k + i r_k sigma_k) - 2 Theta_k.
 * No numbers of opposite sign are added but in Theta. Requires: D != 0, on the separatrix a number below the rounding
 * error of D. */
static inline elliptic elliptic_by_means(real t, real A, real B, real D, real N)
{
  real a[LANDEN_STEPS + 1], b[LANDEN_STEPS + 1], c[LANDEN_STEPS + 1], r[LANDEN_STEPS + 1];
  real n = MATH(sqrt)(N), weight = 1, rate = 0;
  elliptic at = {.dn = 1, .cosine = 1};
  int k = 0;
  a[0] = MATH(sqrt)(larger(A, B));
  b[0] = MATH(sqrt)(D);
  c[0] = MATH(sqrt)(A < B ? A : B);
  do {
    r[k + 1] = MATH(sqrt)(a[k] * a[k] + n * n);
    rate += weight * r[k + 1];
    weight *= -2;
    n = c[k] * c[k] / (2 * (n + MATH(sqrt)(n * n + c[k] * c[k])) + REAL_MIN);
    a[k + 1] = (a[k] + b[k]) / 2;
    b[k + 1] = MATH(sqrt)(a[k] * b[k]);
    c[k + 1] = (a[k] - b[k]) / 2;
    k++;
  } while (k < LANDEN_STEPS && (c[k] * c[k] + n * n) * 64 > REAL_EPSILON * larger(a[k] * a[k], 1 / (t * t)));
  at.sigma = MATH(sin)(a[k] * t) / a[k];
  at.cn = MATH(cos)(a[k] * t);
  for (; k > 0; k--) {
    const real cn = at.cn, product = cn * at.dn, turned = r[k] * at.sigma, square = a[k] * at.sigma * at.sigma;
    const real over = 1 / (1 + c[k] * square), size = 1 / MATH(sqrt)(product * product + turned * turned);
    turn_phase(&at, at.cosine, at.sine);
    at.sine = -at.sine;
    turn_phase(&at, product * size, -turned * size);
    at.dn = (cn * cn + b[k - 1] * square) * over;
    at.cn = product * over;
    at.sigma *= over;
  }
  turn_phase(&at, MATH(cos)(rate * t), MATH(sin)(rate * t));
  if (A < B) {
    const real cn = at.cn;
    at.cn = at.dn;
    at.dn = cn;
  }
  return at;
}

enum { DOUBLINGS = 6 };

/* Computes g of a body with three different moments. With the axis m of the moment between those of the axes l and s,
 * in cyclic order, U = 2 T - a_s |Pi|^2, V = a_l |Pi|^2 - 2 T, and
 *   A = (a_l - a_m) U,   B = (a_m - a_s) V,   N = (a_m - a_s) U,   Q = (a_m - a_s) |a_l - a_s| |U| |Pi|,
 * sigma, cn, dn and Theta at t/2, Pi = P after half of the time is by the addition theorem
 *   P_l = (Pi_l dn - (a_m - a_s) sigma cn Pi_m Pi_s)/d,     d = ((a_l - a_s) Pi_s^2 + (a_l - a_m) dn^2 Pi_m^2)/V,
 *   P_m = (Pi_m cn dn + (a_l - a_s) sigma Pi_l Pi_s)/d,     P_s = (Pi_s cn - (a_l - a_m) sigma dn Pi_l Pi_m)/d,
 * and, with Phi = a_s |Pi| t/2 + sign(a_l - a_s) Theta, C = cos Phi, S = sin Phi/|Pi|, 1 + g has the direction of
 *   (C cn - S U sigma dn,  (S cn dn + C (a_l - a_s) sigma) P_l,  (S dn + C (a_m - a_s) sigma cn) P_m,
 *    S (1 + N sigma^2) P_s):
 * the scalar part depends on the invariants only, the vector part is linear in P, as the motion is reversible. */
#ifdef __GNUC__
__attribute__((noinline)) /* inlined it takes registers from the code of symmetric bodies */
#endif
static void turn_asymmetric(const free_body *body, real t, const real *restrict Pi, real *restrict g)
{
  const int l = body->l, m = body->m, s = body->s;
  const real ls = body->ls, ms = body->ms, lm = body->lm, a_m = body->a_m, a_s = body->a_s, half = t / 2;
  const real x = Pi[l], y = Pi[m], z = Pi[s], U = ls * x * x + ms * y * y, V = ls * z * z + lm * y * y;
  const real A = lm * U, B = ms * V, N = ms * U, square = x * x + y * y + z * z;
  const real outer = ls * lm * x * x, inner = ls * ms * z * z, rounding = REAL_EPSILON / 4 * (outer + inner);
  const int first = MATH(fabs)(U) > MATH(fabs)(V);
  real cosine, sine, whole;
  if (rounding == 0) { /* Pi is constant */
    half_turn(a_m * a_m * square * half * half, g, &sine);
    for (int i = 0; i < 3; i++)
      g[1 + i] = sine * a_m * half * Pi[i];
    return;
  }
  int n = 0;
  for (real scale = larger(A, B + N) * half * half * 4096; scale > 1 && n <= DOUBLINGS; scale /= 4)
    n++;
  elliptic at;
  real d;
  if (n == 0) {
    at = elliptic_by_series(half, A, B, N);
    const real rate = a_s * half + N * ls * at.sine;
    half_turn(rate * rate * square, &cosine, &sine);
    at.cosine = 1 + cosine;
    at.sine = rate * sine;
    d = 1 - ms * lm * at.sigma * at.sigma * y * y;
  } else {
    const real norm = MATH(sqrt)(square), angle = a_s * norm * half;
    at = n <= DOUBLINGS ? elliptic_by_doubling(half, n, A, B, N, N * MATH(fabs)(ls) * norm)
                        : elliptic_by_means(half, A, B, MATH(fabs)(outer - inner) + rounding, N);
    d = first ? (ls * x * x + ms * y * y * at.cn * at.cn) / U : (ls * z * z + lm * y * y * at.dn * at.dn) / V;
    half_turn(angle * angle, &cosine, &sine);
    at.sine = ls < 0 ? -at.sine : at.sine;
    turn_phase(&at, 1 + cosine, angle * sine);
    at.sine /= norm;
  }
  const real C = at.cosine, S = at.sine, sigma = at.sigma, cn = at.cn, dn = at.dn;
  g[0] = (C * cn - S * U * sigma * dn) * d;
  g[1 + l] = (S * cn * dn + C * ls * sigma) * (x * dn - ms * sigma * cn * y * z);
  g[1 + m] = (S * dn + C * ms * sigma * cn) * (y * cn * dn + ls * sigma * x * z);
  g[1 + s] = S * (1 + N * sigma * sigma) * (z * cn - lm * sigma * dn * x * y);
  sine = g[1] * g[1] + g[2] * g[2] + g[3] * g[3];
  whole = MATH(sqrt)(g[0] * g[0] + sine);
  for (int i = 1; i < 4; i++)
    g[i] /= whole;
  g[0] = g[0] > 0 ? -sine / (whole * (whole + g[0])) : g[0] / whole - 1;
}

/* Multiplies a vector by the matrix C, or by its transpose, and restores the length, so that it does not drift. */
static inline void turn_axes(const real *C, int transposed, real *v)
{
  real u[3], before = REAL_MIN, after = REAL_MIN;
  for (int i = 0; i < 3; i++) {
    u[i] = 0;
    for (int j = 0; j < 3; j++)
      u[i] += C[transposed ? 3 * j + i : 3 * i + j] * v[j];
    before += v[i] * v[i];
    after += u[i] * u[i];
  }
  for (int i = 0; i < 3; i++)
    v[i] = u[i] + u[i] * ((before - after) / (before + after));
}

/* Adds the changes of q and p in the time t to the increments dq and dp, with which they are q0 + dq and p; `axis` is
 * that of symmetry, if there is one, and C contains the principal axes as columns, NULL for those of the body. */
static inline void turn_body(const step_data *step, int first, int axis, const free_body *body, const real *C, real t,
    const real *restrict p, real *restrict dq, real *restrict dp)
{
  real q[4], Pi[3], g[4], changes[2][4];
  for (int i = 0; i < 4; i++)
    q[i] = step->q0[first + i] + (step->carry_q[first + i] + dq[i]);
  Pi[0] = (q[0] * p[1] - q[1] * p[0] + q[3] * p[2] - q[2] * p[3]) / 2;
  Pi[1] = (q[0] * p[2] - q[2] * p[0] + q[1] * p[3] - q[3] * p[1]) / 2;
  Pi[2] = (q[0] * p[3] - q[3] * p[0] + q[2] * p[1] - q[1] * p[2]) / 2;
  if (C)
    turn_axes(C, 1, Pi);
  if (body->lm == 0 && body->s == axis)
    turn_symmetric(axis, body, t, Pi, g);
  else
    turn_asymmetric(body, t, Pi, g);
  if (C)
    turn_axes(C, 0, g + 1);
  multiply(q, g, changes[0]);
  multiply(p, g, changes[1]);
  for (int i = 0; i < 4; i++) {
    dq[i] += changes[0][i];
    dp[i] += changes[1][i];
  }
}
