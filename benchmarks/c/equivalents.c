/* Hand-written C of models that users write: J (Eq. 10) of a population, free run, to time generated kernels against.
 * As a careful programmer would: individuals side by side in lanes of W, state in lane arrays, what one step has read
 * kept for the next, no trajectory stored where no lag needs one.
 * Build: cc -O3 -march=native -ffast-math -fopenmp-simd -DW=16 -shared -fPIC equivalents.c -lm
 * theta: K rows (parameters, in the model's order) of P values, P a multiple of W; u: the input on its fine grid, `zero`
 * the index at t = 0, `points` fine points in an integration step; y: N measured values; work: zeroed history; J: P. */
#include <math.h>
#ifndef W
#define W 16
#endif
#define LANES _Pragma("omp simd") for (int j = 0; j < W; j++)
#define ARGUMENTS                                                                                                        \
  const double *restrict theta, long P, const double *restrict u, long zero, long points, const double *restrict y,     \
      long N, double h, double *restrict work, double *restrict J
#define ROW(i) theta[(i) * P + p0 + j]

/* dy/dt = (K u(t - L) - y)/T, RK4; y(0) measured. */
void tube(ARGUMENTS) {
  (void)work;
  for (long p0 = 0; p0 < P; p0 += W) {
    double gain[W], rate[W], part[W], sum[W], x[W], before[W], start[W];
    long offset[W];
    LANES {
      double d = ROW(2) / h * points;
      long whole = (long)d;
      rate[j] = 1 / ROW(1), gain[j] = ROW(0) * rate[j], part[j] = d - whole;
      offset[j] = zero - whole;
      before[j] = u[offset[j] - 1], start[j] = u[offset[j]];
      sum[j] = 0, x[j] = y[0];
    }
    for (long k = 0; k < N - 1; k++) {
      const double *at = u + k * points;
      LANES {
        double middle = at[offset[j] + 1], end = at[offset[j] + 2];
        double f0 = gain[j] * (start[j] + part[j] * (before[j] - start[j]));
        double f1 = gain[j] * (middle + part[j] * (start[j] - middle));
        double f2 = gain[j] * (end + part[j] * (middle - end));
        double k1 = f0 - rate[j] * x[j];
        double k2 = f1 - rate[j] * (x[j] + 0.5 * h * k1);
        double k3 = f1 - rate[j] * (x[j] + 0.5 * h * k2);
        double k4 = f2 - rate[j] * (x[j] + h * k3);
        x[j] += h / 6 * (k1 + k4 + 2 * (k2 + k3));
        before[j] = middle, start[j] = end;
        double e = y[k + 1] - x[j];
        sum[j] += e * e;
      }
    }
    LANES J[p0 + j] = sqrt(sum[j] / N);
  }
}

/* y'' = b u(t - L) - d y' - k1 y - k2 y^2 - k3 y^3 - c, RK4 with two steps a sample; y(0) and its first difference. */
void silverbox(ARGUMENTS) {
  (void)work;
  double step = h / 2;
  for (long p0 = 0; p0 < P; p0 += W) {
    double b[W], d[W], k1[W], k2[W], k3[W], c[W], part[W], sum[W], x[W], v[W], before[W], start[W];
    long offset[W];
    LANES {
      double lag = ROW(6) / step * points;
      long whole = (long)lag;
      b[j] = ROW(0), d[j] = ROW(1), k1[j] = ROW(2), k2[j] = ROW(3), k3[j] = ROW(4), c[j] = ROW(5);
      part[j] = lag - whole, offset[j] = zero - whole;
      before[j] = u[offset[j] - 1], start[j] = u[offset[j]];
      sum[j] = 0, x[j] = y[0], v[j] = (y[1] - y[0]) / h;
    }
    for (long k = 0; k < 2 * (N - 1); k++) {
      const double *at = u + k * points;
      LANES {
        const double *here = at + offset[j];
        double middle = here[points / 2], middle_before = here[points / 2 - 1];
        double end = here[points], end_before = here[points - 1];
        double f0 = b[j] * (start[j] + part[j] * (before[j] - start[j])) - c[j];
        double f1 = b[j] * (middle + part[j] * (middle_before - middle)) - c[j];
        double f2 = b[j] * (end + part[j] * (end_before - end)) - c[j];
#define FORCE(f, x, v) ((f) - d[j] * (v) - (x) * (k1[j] + (x) * (k2[j] + k3[j] * (x))))
        double xs, vs, a1, a2, a3, a4, v2, v3, v4;
        a1 = FORCE(f0, x[j], v[j]);
        xs = x[j] + 0.5 * step * v[j], v2 = v[j] + 0.5 * step * a1, a2 = FORCE(f1, xs, v2);
        xs = x[j] + 0.5 * step * v2, v3 = v[j] + 0.5 * step * a2, a3 = FORCE(f1, xs, v3);
        xs = x[j] + step * v3, v4 = v[j] + step * a3, a4 = FORCE(f2, xs, v4);
        vs = v[j];
        x[j] += step / 6 * (vs + v4 + 2 * (v2 + v3));
        v[j] += step / 6 * (a1 + a4 + 2 * (a2 + a3));
        before[j] = end_before, start[j] = end;
      }
      if (k & 1) LANES {
        double e = y[(k + 1) / 2] - x[j];
        sum[j] += e * e;
      }
    }
    LANES J[p0 + j] = sqrt(sum[j] / N);
  }
}

/* Eq. 16 with the force of Eq. 17-18: Coulomb friction by the sign of the last step; lags up to the history's front. */
void coulomb(ARGUMENTS) {
  (void)points;
  for (long p0 = 0; p0 < P; p0 += W) {
    double damping[W], spring[W], friction[W], part[W], sum[W], tap[W], delayed[W], x0[W], x1[W];
    long offset[W], pad = 64;
    LANES {
      double d = ROW(1) / h;
      long whole = (long)d;
      part[j] = d - whole, offset[j] = (1 - whole) * W + j;
      damping[j] = ROW(0) * h, spring[j] = 1 + h * h * ROW(2), friction[j] = h * h * ROW(3);
      sum[j] = y[0] * y[0] + y[1] * y[1], tap[j] = delayed[j] = x0[j] = x1[j] = 0;
    }
    for (long k = 0; k < pad * W + 2 * W; k++) work[k] = 0;
    for (long k = 0; k < N - 2; k++) {
      double *row = work + (k + pad) * W;
      double force = h * h * u[zero + k * points];
#pragma GCC ivdep
      for (int j = 0; j < W; j++) {
        double newest = row[offset[j]];
        double now = newest + part[j] * (tap[j] - newest);
        double change = now - delayed[j], moved = x1[j] - x0[j];
        double sign = (moved > 0) - (moved < 0);
        tap[j] = newest, delayed[j] = now;
        double next = 2 * x1[j] - damping[j] * change - spring[j] * x0[j] - friction[j] * sign + force;
        row[2 * W + j] = next;
        x0[j] = x1[j], x1[j] = next;
        double e = y[k + 2] - next;
        sum[j] += e * e;
      }
    }
    LANES J[p0 + j] = sqrt(sum[j] / N);
  }
}

/* 13 terms of a cubic NARX: 1 u u1 y1 y2 y1^2 y1 y2 y1^3 y1^2 y2 y1 y2^2 y2^3 y1 u y1^2 u; the first two samples are its start and not scored. */
void narx(ARGUMENTS) {
  (void)work, (void)points, (void)h;
  for (long p0 = 0; p0 < P; p0 += W) {
    double a[13][W], sum[W], y1[W], y2[W];
    for (int i = 0; i < 13; i++) LANES a[i][j] = ROW(i);
    LANES sum[j] = 0, y1[j] = y[1], y2[j] = y[0];
    for (long k = 2; k < N; k++) {
      double u0 = u[zero + k * points], u1 = u[zero + (k - 1) * points];
      LANES {
        double p = y1[j], q = y2[j], s = p * p, t = q * q;
        double next = a[0][j] * p + a[1][j] * q + a[2][j] * u0 + a[3][j] * u1 + a[4][j] * s + a[5][j] * p * q +
                      a[6][j] * s * p + a[7][j] * s * q + a[8][j] * p * t + a[9][j] * q * t + a[10][j] * p * u0 +
                      a[11][j] * s * u0 + a[12][j] * t;
        y2[j] = p, y1[j] = next;
        double e = y[k] - next;
        sum[j] += e * e;
      }
    }
    LANES J[p0 + j] = sqrt(sum[j] / (N - 2));
  }
}

/* dx/dt = beta x(t - L)/(1 + x(t - L)^n) - gamma x, RK4; lags from two steps up to the history's front; x(0) measured.
 * Each step has a cubic through its values and slopes. The history has what the lag reads of it: whole and half steps. */
void mackey(ARGUMENTS) {
  (void)u, (void)zero, (void)points;
  long pad = 128;
  for (long p0 = 0; p0 < P; p0 += W) {
    double beta[W], gamma[W], n[W], sum[W], x[W], older[W], rise[W], last[W], middle[W], first[W];
    double line[2][W], begin[2][W], end[2][W];
    long offset[W], late[W];
    LANES {
      double d = ROW(3) / h;
      long whole = (long)d;
      beta[j] = ROW(0), gamma[j] = ROW(1), n[j] = ROW(2);
      offset[j] = (1 - whole) * 2 * W + j, late[j] = d - whole < 0.5;
      for (int i = 0; i < 2; i++) {
        double f = i == 0 ? d - whole : d - whole + (late[j] ? 0.5 : -0.5);
        begin[i][j] = f * f * (1 - f), end[i][j] = -f * (1 - f) * (1 - f);
        line[i][j] = f + begin[i][j] + end[i][j];
      }
      sum[j] = rise[j] = last[j] = 0, x[j] = older[j] = middle[j] = y[0];
      first[j] = beta[j] * y[0] / (1 + pow(y[0], n[j]));
    }
    for (long k = 0; k < 2 * pad; k++) LANES work[k * W + j] = y[0];
    for (long k = 0; k < N - 1; k++) {
      double *row = work + (k + pad) * 2 * W, half[W], whole[W], powers[2][W];
      for (int i = 0; i < 2; i++)
        LANES row[i * W + j] =
            x[j] + line[i][j] * (older[j] - x[j]) + begin[i][j] * rise[j] + end[i][j] * last[j];
#pragma GCC ivdep
      for (int j = 0; j < W; j++) {
        double ahead = row[offset[j] + W];
        whole[j] = row[offset[j]], half[j] = late[j] ? ahead : middle[j], middle[j] = ahead;
      }
      LANES powers[0][j] = pow(half[j], n[j]);
      LANES powers[1][j] = pow(whole[j], n[j]);
      LANES {
        double f1 = beta[j] * half[j] / (1 + powers[0][j]), f2 = beta[j] * whole[j] / (1 + powers[1][j]);
        double k1 = first[j] - gamma[j] * x[j];
        double k2 = f1 - gamma[j] * (x[j] + 0.5 * h * k1);
        double k3 = f1 - gamma[j] * (x[j] + 0.5 * h * k2);
        double k4 = f2 - gamma[j] * (x[j] + h * k3);
        older[j] = x[j], rise[j] = h * k1, last[j] = h * k4, first[j] = f2;
        x[j] += h / 6 * (k1 + k4 + 2 * (k2 + k3));
        double e = y[k + 1] - x[j];
        sum[j] += e * e;
      }
    }
    LANES J[p0 + j] = sqrt(sum[j] / N);
  }
}

/* Stick-slip actuator (Eq. 23-25), 8 steps a sample, the instants of stopping and breaking away inside a step; rows
 * J, F_c, F_max, k_a = k_b, k_c and the first angle; volume swept, viscous friction and end stop as in the catalogue. */
void actuator(ARGUMENTS) {
  (void)work;
  const double swept = 5e-6, viscous = 1e-3, stop = 2.356194490192345, s = h / 8;
  for (long p0 = 0; p0 < P; p0 += W) {
    double inertia[W], coulomb[W], breakaway[W], rate[W], gain[W], sum[W], angle[W], speed[W], pressure[W];
    LANES {
      inertia[j] = ROW(0), coulomb[j] = ROW(1), breakaway[j] = ROW(2), rate[j] = ROW(3), gain[j] = ROW(4);
      angle[j] = ROW(5), speed[j] = pressure[j] = 0;
      sum[j] = (y[0] - angle[j]) * (y[0] - angle[j]);
    }
    for (long k = 0; k < 8 * (N - 1); k++) {
      double supply = u[zero + k * points + points / 2];
      LANES {
        double J2 = 2 * inertia[j], Fc = coulomb[j], Fm = breakaway[j], ka = rate[j], kc = gain[j], w = speed[j];
        double p = pressure[j], fed = ka * supply, lag = 1 + s * ka / 2, sign = (w > 0) - (w < 0);
        double w1 = (J2 * w + s * (swept * (p + s * fed / 2) / lag - Fc * sign)) /
                    (J2 + s * viscous + swept * s * s * kc / (2 * lag));
        double slid = w * (2 * w1 - w) > 0 ? 0 : s - s * w / (2 * (w - w1));
        double rest = w == 0 ? s : slid;
        double stopped = p + (s - rest) * ((2 * p + s * (fed - kc * w1)) / lag - 2 * p) / s;
        double rested = (stopped * (1 - rest * ka / 2) + rest * fed) / (1 + rest * ka / 2);
        double way = (rested > 0) - (rested < 0);
        double go = fabs(swept * stopped) > Fm ? stopped : way * Fm / swept;
        double to = (go > 0) - (go < 0);
        double broke = fabs(swept * rested) > Fm ? rest * (fabs(rested) - Fm / swept) / fabs(rested - stopped) : 0;
        double slip = fabs(swept * stopped) > Fm ? rest : broke;
        slip = (to * angle[j] >= stop || rest == 0) ? 0 : slip;
        double late = 1 + slip * ka / 2;
        double push = slip * (to * swept * (go + slip * fed / 2) / late - Fc);
        double w2 = to * (push > 0 ? push : 0) / (J2 + slip * viscous + swept * slip * slip * kc / (2 * late));
        double next = angle[j] + (rest > 0 ? (s - rest) * w / 2 : s * w1) + slip * w2;
        next = next < stop ? next : stop;
        next = next > -stop ? next : -stop;
        double moving = rest > 0 ? 2 * w2 : 2 * w1 - w;
        angle[j] = next, speed[j] = fabs(next) >= stop ? 0 : moving;
        pressure[j] = slip > 0 ? (2 * go + slip * (fed - kc * w2)) / late - go : rested;
      }
      if ((k & 7) == 7) LANES {
        double e = y[(k + 1) / 8] - angle[j];
        sum[j] += e * e;
      }
    }
    LANES J[p0 + j] = sqrt(sum[j] / N);
  }
}

/* Multiply-adds a call, for the machine's peak: 2 * W * 8 * turns operations in independent chains. */
double peak(long turns) {
  double x[8][W], total = 0;
  for (int i = 0; i < 8; i++) LANES x[i][j] = 1e-9 * (i * W + j);
  for (long k = 0; k < turns; k++)
    for (int i = 0; i < 8; i++) LANES x[i][j] = x[i][j] * 0.999999 + 1e-7;
  for (int i = 0; i < 8; i++) LANES total += x[i][j];
  return total;
}
