// Correction N = Jr(θ) − 1 of the moment arm of a rotating body: the mean over a step less the arm at the step's end
// (arc_correction.hpp applies it to contact springs, free_body.hpp to the weight).
#pragma once

#include "math/spatial.hpp"

namespace gelflow {

// N = Jr(θ) − 1 and its derivatives: with K = [θ]×, N = −a K + b K², a = (1 − cos θ)/θ², b = (θ − sin θ)/θ³.
template <class T>
struct MomentArmCorrection {
  M3<T> value, derivative[3];
  explicit MomentArmCorrection(const V3<T>& theta, bool derivatives) {
    const T squared = theta.squaredNorm();
    const RotationSeries<T> s(squared);
    const M3<T> k = skew<T>(theta), kk = k * k;
    const T a = s.one_minus_cos, b = s.theta_minus_sin;
    value = b * kk - a * k;
    if (!derivatives) return;
    T a1 = squared / T(180) - T(1.0 / 12), b1 = squared / T(1260) - T(1.0 / 60);  // a'/θ, b'/θ
    if (!(real_part(squared) < 1e-4)) {
      a1 = (T(1) - T(2) * a) / squared - b;
      b1 = (a - T(3) * b) / squared;
    }
    const M3<T> along = b1 * kk - a1 * k;
    for (int j = 0; j < 3; ++j) {
      const M3<T> e = skew<T>(V3<T>(V3<T>::Unit(j)));
      derivative[j] = b * (e * k + k * e) - a * e + theta[j] * along;
    }
  }
};

}  // namespace gelflow
