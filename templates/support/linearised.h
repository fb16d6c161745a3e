/* A step with what it is linearised by. Before it: newton.h, linear_maps.h, and FAMILIES. */

enum {
  COUNT_OF_FAMILIES = sizeof FAMILIES / sizeof *FAMILIES
};

/* What one step is linearised by: the solved step; its slopes at points; room for what changes. */
typedef struct {
  const step_data *step;
  newton_data data;
  band shape;
  real *slopes;
  wide *v, *dz, *rows, *x, *points;
  wide *grown; /* changes of gamma h; NULL without damping */
  real growth; /* gamma h */
  real p1[M];
} linearised_step;
