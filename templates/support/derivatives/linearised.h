#ifndef SUPPORT_LINEARISED_H
#define SUPPORT_LINEARISED_H

#include "../newton/newton.h"
#include "linear_maps.h"

/* Linearisation of a step. Requires: newton.h, linear_maps.h, and STAGE_GROUPS. */

enum {
  COUNT_OF_GROUPS = sizeof STAGE_GROUPS / sizeof *STAGE_GROUPS
};

/* The solved step, its derivatives at the points, and memory for tangent or adjoint vectors. */
typedef struct {
  const step_data *step;
  newton_data *data;
  band shape;
  real *partials;
  wide *v, *dz, *rows, *x, *points;
  wide *grown; /* variations of gamma h; NULL without damping */
  real growth; /* gamma h */
  real p1[M];
} linearised_step;

#endif
