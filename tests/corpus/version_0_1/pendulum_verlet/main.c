/* Runs pendulum_verlet and prints t, q, p and the energy error, a line for each state. Build and run: make run */
#include "pendulum_verlet.h"

#include <stdio.h>

#define M PENDULUM_VERLET_COORDINATES

/* Initial state; parameters; workspace, which may be too large for the stack. */
static const double q0[M] = {
  2.0, /* q */
};
static const double p0[M] = {
  0.0, /* q */
};
static const double parameters[] = {
  1.0, /* m */
  1.0, /* l */
  1.0, /* g */
};
static double workspace[PENDULUM_VERLET_WORKSPACE];
static pendulum_verlet_run run;

static double energy_at(double t, const double *q, const double *p)
{
  double energy = 0.0;
  if (pendulum_verlet_energy(t, q, p, parameters, &energy, workspace) != PENDULUM_VERLET_OK)
    fprintf(stderr, "the energy at t = %g cannot be computed\n", t);
  return energy;
}

static void print_state(double t, const double *q, const double *p, double energy_error)
{
  printf("%.17g", t);
  for (int i = 0; i < M; i++)
    printf(" %.17g", q[i]);
  for (int i = 0; i < M; i++)
    printf(" %.17g", p[i]);
  printf(" %.3e\n", energy_error);
}

int main(void)
{
  const double t0 = 0.0, h = 0.5;
  const double energy0 = energy_at(t0, q0, p0);
  puts("# t q p_q energy_error");
  print_state(t0, q0, p0, 0.0);
  pendulum_verlet_start(&run, t0, h, q0, p0);
  for (int k = 0; k < 20; k++) {
    static double q[M], p[M];
    double t = t0;
    int iterations = 0;
    pendulum_verlet_report report;
    const int status = pendulum_verlet_advance(&run, 10, 10, parameters, NULL,
        &t, q, p, &iterations, &report, workspace);
    if (status != PENDULUM_VERLET_OK) {
      fprintf(stderr, "the step from t = %g failed with status %d\n", report.t, status);
      return 1;
    }
    print_state(t, q, p, energy_at(t, q, p) - energy0);
  }
  return 0;
}
