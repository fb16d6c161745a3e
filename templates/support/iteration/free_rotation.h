#include "../core/choices.h"

#if defined(__GNUC__) && !defined(__clang__) && !defined(LANES)
#pragma GCC optimize("no-tree-slp-vectorize") /* its vectors wait for stores of single numbers: a seventh of the time */
#endif

/* Free rotation of a rigid body with quaternion q, its momentum p, and Pi = E(q)^T p/2 in the body frame, exact to
 * round-off:
 *   T = (a_1 Pi_1^2 + a_2 Pi_2^2 + a_3 Pi_3^2)/2,   q <- q g,   p <- p g,   |g| = 1.
 * Two equal moments, a_i = a_j: rotations about the angular momentum and a body axis (E. J. Routh, Advanced Rigid
 * Dynamics). Three different ones: Jacobi's elliptic functions (E. Celledoni, F. Fasso, N. Saefstroem, A. Zanna, SIAM
 * J. Sci. Comput. 30 (2008), 2084-2112; R. van Zon, J. Schofield, J. Comput. Phys. 225 (2007), 145-164). Of many
 * trajectories, which are SIMD lanes, if LANES is defined: each lane keeps the results of its own formulas. */

#ifdef LANES
LANE_BY_LANE(root_of, MATH(sqrt));
LANE_BY_LANE(sine_of, MATH(sin));

static inline void phase_of(lanes angle, lanes *cosine, lanes *sine)
{
  lane_view at = {angle}, c, s;
  for (int j = 0; j < LANES; j++) {
    c.lane[j] = MATH(cos)(at.lane[j]);
    s.lane[j] = MATH(sin)(at.lane[j]);
  }
  *cosine = c.all;
  *sine = s.all;
}
#else
#define root_of(x) MATH(sqrt)(x)
#define sine_of(x) MATH(sin)(x)
#define phase_of(angle, cosine, sine) (*(cosine) = MATH(cos)(angle), *(sine) = MATH(sin)(angle))
#endif
#define OVER(n) (1 / (real)(n)) /* reciprocal of a factorial */

#ifdef __GNUC__
#define APART __attribute__((noinline)) /* inlined it takes registers from the code of symmetric bodies */
#else
#define APART
#endif

/* Computes cos(x) - 1 and sin(x)/x from x^2, by their series for small x. */
static inline void half_turn(number x2, number *cosine, number *sine)
{
  const condition small = x2 < (real)0.25;
  *cosine = *sine = number_of(0);
  if (any_of(small)) {
    const number x4 = x2 * x2, x8 = x4 * x4;
    *cosine = -x2 * (OVER(2) - x2 * OVER(24) + x4 * (OVER(720) - x2 * OVER(40320)));
    *cosine -= x2 * x8 * (OVER(3628800) - x2 * OVER(479001600) + x4 * OVER(87178291200));
    *sine = 1 - x2 * OVER(6) + x4 * (OVER(120) - x2 * OVER(5040));
    *sine += x8 * (OVER(362880) - x2 * OVER(39916800) + x4 * (OVER(6227020800) - x2 * OVER(1307674368000)));
  }
  if (!all_of(small)) {
    const number x = root_of(x2), half = sine_of(x / 2);
    *cosine = where(small, *cosine, -2 * half * half);
    *sine = where(small, *sine, sine_of(x) / x);
  }
}

/* Computes a b for quaternions. */
static inline void multiply(const number *restrict a, const number *restrict b, number *restrict product)
{
  product[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  product[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  product[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  product[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

/* Axes l, m, s of a body in cyclic order with a_m between a_l and a_s, and differences ls = a_l - a_s, ms = a_m - a_s,
 * lm = a_l - a_m, which is 0 if two moments are equal. */
typedef struct {
  number m, a_m, a_s, ls, ms, lm;
} free_body;

/* Components of v about the axes l, m, s from those about 0, 1, 2, where m is 0 if `first`, 2 if `last`, else 1; the
 * inverse if the two are exchanged. */
static inline void cycle(condition first, condition last, const number *v, number *cycled)
{
#ifdef LANES
  for (int i = 0; i < 3; i++)
    cycled[i] = where(first, v[(i + 2) % 3], where(last, v[(i + 1) % 3], v[i]));
#else
  const int ahead = first ? 2 : last; /* waits for fewer instructions than choices between numbers */
  for (int i = 0; i < 3; i++)
    cycled[i] = v[(i + ahead) % 3];
#endif
}

/* Sorts the axes, from the axes j and k and a_i, a_j - a_i, a_k - a_i; a_i = a_j are those of l and m. */
static inline free_body sorted_axes(const int *axes, const number *rates)
{
  number a[3] = {rates[0], rates[0], rates[0]}, sorted[3];
  a[axes[0]] += rates[1];
  a[axes[1]] += rates[2];
  const condition low = a[0] < a[1], end = low == (a[2] < a[0]), middle = low == (a[1] < a[2]);
  const number between = where(middle, number_of(1), where(end, number_of(0), number_of(2)));
  const number m = where(rates[1] == 0, number_of((axes[1] + 2) % 3), between);
  cycle(m == 0, m == 2, a, sorted);
  const number a_l = sorted[0], a_m = sorted[1], a_s = sorted[2];
  const free_body body = {m, a_m, a_s, a_l - a_s, a_m - a_s, a_l - a_m};
  return body;
}

/* Computes g with 1 + g = exp(t a_m Pi/2) exp(t (a_s - a_m) Pi_s e_s/2) for a_l = a_m and a constant s. */
static inline void turn_symmetric(int s, const free_body *body, real t, const number *restrict Pi, number *restrict g)
{
  const number about = -t * body->ms * Pi[s] / 2;
  number r[4] = {number_of(0)}, product[4], x2 = number_of(0), sine;
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
  number sigma, cn, dn, cosine, sine;
} elliptic;

/* Computes sigma, cn, dn, and Theta/Q as sine, by Taylor series for A t^2, (B + N) t^2 < 2^-12. */
static inline elliptic elliptic_by_series(number t, number A, number B, number N)
{
  const number t2 = t * t, p = (A + B) * t2, q = A * B * t2 * t2, r = N * t2, p2 = p * p;
  const number sigma = t * (1 - p / 6 + (p2 + 12 * q) / 120 - p * (p2 + 132 * q) / 5040);
  const number x = A * sigma * sigma, y = B * sigma * sigma, fourth = 2 * p2 / 45 + q / 5 + r * (2 * p / 3 + r);
  const number sixth = p2 * p / 315 + 3 * p * q / 35 + r * ((p2 + 2 * q) / 5 + r * (p + r));
  const elliptic at = {.sigma = sigma,
      .cn = 1 - x * (OVER(2) + x * (OVER(8) + x * (OVER(16) + x * (5 * OVER(128))))),
      .dn = 1 - y * (OVER(2) + y * (OVER(8) + y * (OVER(16) + y * (5 * OVER(128))))),
      .cosine = number_of(1),
      .sine = t * t2 * (OVER(3) - (p / 3 + r) / 5 + fourth / 7 - sixth / 9)};
  return at;
}

/* Multiplies exp(i Theta) by x + i y. */
static inline void turn_phase(elliptic *at, number x, number y)
{
  const number cosine = at->cosine;
  at->cosine = cosine * x - at->sine * y;
  at->sine = cosine * y + at->sine * x;
}

/* `at` where the condition holds, `otherwise` elsewhere. */
static inline elliptic elliptic_where(condition holds, elliptic at, elliptic otherwise)
{
  at.sigma = where(holds, at.sigma, otherwise.sigma);
  at.cn = where(holds, at.cn, otherwise.cn);
  at.dn = where(holds, at.dn, otherwise.dn);
  at.cosine = where(holds, at.cosine, otherwise.cosine);
  at.sine = where(holds, at.sine, otherwise.sine);
  return at;
}

/* Computes them by series at t and n times the formulas for twice the argument,
 *   sigma <- 2 sigma cn dn/(1 - A B sigma^4), .., Theta <- 2 Theta + arg(1 + N (sigma_2^2 - sigma^2 cn_2 dn_2)
 *     + i Q sigma^2 sigma_2),   where the index 2 denotes values at twice the argument. */
static inline elliptic elliptic_by_doubling(number t, number n, number A, number B, number N, number Q)
{
  elliptic at = elliptic_by_series(t, A, B, N);
  at.sine *= Q;
  at.cosine -= at.sine * at.sine / 2;
  for (; any_of(n > 0); n -= 1) {
    const elliptic before = at;
    const number u = at.sigma * at.sigma, k = A * B * u * u, over = 1 / (1 - k);
    at.sigma *= 2 * at.cn * at.dn * over;
    at.cn = (1 + k - 2 * A * u) * over;
    at.dn = (1 + k - 2 * B * u) * over;
    turn_phase(&at, at.cosine, at.sine);
    turn_phase(&at, 1 + N * (at.sigma * at.sigma - u * at.cn * at.dn), Q * u * at.sigma);
    at = elliptic_where(n > 0, at, before);
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
 * error of D. Lanes where `live` is false decide about no step. */
static inline elliptic elliptic_by_means(condition live, real t, number A, number B, number D, number N)
{
  number a[LANDEN_STEPS + 1], b[LANDEN_STEPS + 1], c[LANDEN_STEPS + 1], r[LANDEN_STEPS + 1];
  condition taken[LANDEN_STEPS + 1];
  number n = root_of(N), rate = number_of(0), cosine, sine;
  real share = 1;
  elliptic at = {.dn = number_of(1), .cosine = number_of(1)};
  int k = 0;
  a[0] = root_of(larger_number(A, B));
  b[0] = root_of(D);
  c[0] = root_of(where(A < B, A, B));
  do {
    k++;
    taken[k] = live;
    r[k] = root_of(a[k - 1] * a[k - 1] + n * n);
    rate = where(live, rate + share * r[k], rate);
    share *= -2;
    n = c[k - 1] * c[k - 1] / (2 * (n + root_of(n * n + c[k - 1] * c[k - 1])) + REAL_MIN);
    a[k] = where(live, (a[k - 1] + b[k - 1]) / 2, a[k - 1]);
    b[k] = root_of(a[k - 1] * b[k - 1]);
    c[k] = (a[k - 1] - b[k - 1]) / 2;
    live &= (c[k] * c[k] + n * n) * 64 > REAL_EPSILON * larger_number(a[k] * a[k], number_of(1 / (t * t)));
  } while (k < LANDEN_STEPS && any_of(live));
  phase_of(a[k] * t, &at.cn, &at.sigma);
  at.sigma /= a[k];
  for (; k > 0; k--) {
    const elliptic before = at;
    const number cn = at.cn, product = cn * at.dn, turned = r[k] * at.sigma, square = a[k] * at.sigma * at.sigma;
    const number over = 1 / (1 + c[k] * square), size = 1 / root_of(product * product + turned * turned);
    turn_phase(&at, at.cosine, at.sine);
    at.sine = -at.sine;
    turn_phase(&at, product * size, -turned * size);
    at.dn = (cn * cn + b[k - 1] * square) * over;
    at.cn = product * over;
    at.sigma *= over;
    at = elliptic_where(taken[k], at, before);
  }
  phase_of(rate * t, &cosine, &sine);
  turn_phase(&at, cosine, sine);
  const number cn = at.cn;
  at.cn = where(A < B, at.dn, cn);
  at.dn = where(A < B, cn, at.dn);
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
static APART void turn_asymmetric(const free_body *body, real t, const number *restrict Pi, number *restrict g)
{
  number sorted[3], turned[3];
  cycle(body->m == 0, body->m == 2, Pi, sorted);
  const number ls = body->ls, ms = body->ms, lm = body->lm, a_m = body->a_m, a_s = body->a_s;
  const number x = sorted[0], y = sorted[1], z = sorted[2], U = ls * x * x + ms * y * y, V = ls * z * z + lm * y * y;
  const number A = lm * U, B = ms * V, N = ms * U, square = x * x + y * y + z * z;
  const number outer = ls * lm * x * x, inner = ls * ms * z * z, rounding = REAL_EPSILON / 4 * (outer + inner);
  const condition first = magnitude(U) > magnitude(V), constant = rounding == 0; /* Pi is */
  const real half = t / 2;
  number cosine, sine, d = number_of(0), n = d, part = number_of(half);
  if (any_of(constant)) {
    half_turn(a_m * a_m * square * half * half, g, &sine);
    for (int i = 0; i < 3; i++)
      g[1 + i] = sine * a_m * half * Pi[i];
  }
  if (all_of(constant))
    return;
  number scale = larger_number(A, B + N) * half * half * 4096;
  for (int k = 0; k <= DOUBLINGS && any_of(scale > 1); k++, scale /= 4) {
    n = where(scale > 1, n + 1, n);
    part = where(scale > 1, part / 2, part);
  }
  const condition brief = n == 0, by_means = n > DOUBLINGS;
  elliptic at;
  if (any_of(brief)) {
    at = elliptic_by_series(number_of(half), A, B, N);
    const number rate = a_s * half + N * ls * at.sine;
    half_turn(rate * rate * square, &cosine, &sine);
    at.cosine = 1 + cosine;
    at.sine = rate * sine;
    d = 1 - ms * lm * at.sigma * at.sigma * y * y;
  }
  if (!all_of(brief)) {
    const number norm = root_of(square), angle = a_s * norm * half;
    elliptic of_long;
    if (!all_of(by_means))
      of_long = elliptic_by_doubling(part, where(by_means, number_of(0), n), A, B, N, N * magnitude(ls) * norm);
    if (any_of(by_means)) {
      const elliptic by = elliptic_by_means(by_means, half, A, B, magnitude(outer - inner) + rounding, N);
      of_long = elliptic_where(by_means, by, of_long);
    }
    const number cn = of_long.cn, dn = of_long.dn;
    const number of_first = ls * x * x + ms * y * y * cn * cn, of_second = ls * z * z + lm * y * y * dn * dn;
    d = where(brief, d, where(first, of_first, of_second) / where(first, U, V));
    half_turn(angle * angle, &cosine, &sine);
    of_long.sine = where(ls < 0, -of_long.sine, of_long.sine);
    turn_phase(&of_long, 1 + cosine, angle * sine);
    of_long.sine /= norm;
    at = elliptic_where(brief, at, of_long);
  }
  const number sigma = at.sigma, cn = at.cn, dn = at.dn;
  cosine = at.cosine, sine = at.sine;
  const number real_part = (cosine * cn - sine * U * sigma * dn) * d;
  sorted[0] = (sine * cn * dn + cosine * ls * sigma) * (x * dn - ms * sigma * cn * y * z);
  sorted[1] = (sine * dn + cosine * ms * sigma * cn) * (y * cn * dn + ls * sigma * x * z);
  sorted[2] = sine * (1 + N * sigma * sigma) * (z * cn - lm * sigma * dn * x * y);
  cycle(body->m == 2, body->m == 0, sorted, turned);
  sine = turned[0] * turned[0] + turned[1] * turned[1] + turned[2] * turned[2];
  const number whole = root_of(real_part * real_part + sine);
  for (int i = 0; i < 3; i++)
    g[1 + i] = where(constant, g[1 + i], turned[i] / whole);
  const number less = where(real_part > 0, -sine / (whole * (whole + real_part)), real_part / whole - 1);
  g[0] = where(constant, g[0], less);
}

/* Multiplies a vector by the matrix C, or by its transpose, and restores the length, so that it does not drift. */
static inline void turn_axes(const real *C, int transposed, number *v)
{
  number u[3], before = number_of(REAL_MIN), after = number_of(REAL_MIN);
  for (int i = 0; i < 3; i++) {
    u[i] = number_of(0);
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
    const number *restrict p, number *restrict dq, number *restrict dp)
{
  number q[4], Pi[3], g[4] = {number_of(0)}, symmetric[4] = {number_of(0)}, changes[2][4];
  for (int i = 0; i < 4; i++)
    q[i] = step->q0[first + i] + (step->carry_q[first + i] + dq[i]);
  Pi[0] = (q[0] * p[1] - q[1] * p[0] + q[3] * p[2] - q[2] * p[3]) / 2;
  Pi[1] = (q[0] * p[2] - q[2] * p[0] + q[1] * p[3] - q[3] * p[1]) / 2;
  Pi[2] = (q[0] * p[3] - q[3] * p[0] + q[2] * p[1] - q[1] * p[2]) / 2;
  if (C)
    turn_axes(C, 1, Pi);
  const condition is_symmetric = (body->lm == 0) & (body->m == number_of((axis + 2) % 3));
  if (!all_of(is_symmetric))
    turn_asymmetric(body, t, Pi, g);
  if (any_of(is_symmetric))
    turn_symmetric(axis, body, t, Pi, symmetric);
  for (int i = 0; i < 4; i++)
    g[i] = where(is_symmetric, symmetric[i], g[i]);
  if (C)
    turn_axes(C, 0, g + 1);
  multiply(q, g, changes[0]);
  multiply(p, g, changes[1]);
  for (int i = 0; i < 4; i++) {
    dq[i] += changes[0][i];
    dp[i] += changes[1][i];
  }
}
