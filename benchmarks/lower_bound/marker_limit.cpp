// Lower bound on the time per marker: the viscous law on a sphere as one loop over arrays of coordinates, without frames,
// weights, broad phase or other shapes, and with results in separate arrays. From the repository's root:
//     c++ -O3 -march=x86-64-v3 -fno-math-errno -fno-trapping-math benchmarks/lower_bound/marker_limit.cpp -o build/limit
//     build/limit
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <vector>

template <class T>
struct Points {
  explicit Points(int n) : x(n), y(n), z(n) {}
  std::vector<T> x, y, z;
};

template <class T>
__attribute__((noinline)) void read(const Points<T>& points, const T* center, T radius, const T* v, const T* w, T kn,
                                    T kt, T mu, T kd, Points<T>& out) {
  const int n = static_cast<int>(points.x.size());
  const T* const xs = points.x.data();
  const T* const ys = points.y.data();
  const T* const zs = points.z.data();
  T* const fx = out.x.data();
  T* const fy = out.y.data();
  T* const fz = out.z.data();
#pragma GCC ivdep
  for (int i = 0; i < n; ++i) {
    const T x = xs[i], y = ys[i], z = zs[i];
    const T a = x - center[0], b = y - center[1], c = z - center[2];
    const T length = std::sqrt(a * a + b * b + c * c), inverse = T(1) / length, distance = length - radius;
    const T nx = a * inverse, ny = b * inverse, nz = c * inverse;
    const T vx = v[0] + w[1] * z - w[2] * y, vy = v[1] + w[2] * x - w[0] * z, vz = v[2] + w[0] * y - w[1] * x;
    const T rate = nx * vx + ny * vy + nz * vz, stiffness = kn - kd * rate;
    const T normal = distance < 0 && stiffness > 0 ? -stiffness * distance : T(0);
    const T tx = -kt * (vx - rate * nx), ty = -kt * (vy - rate * ny), tz = -kt * (vz - rate * nz);
    const T squared = tx * tx + ty * ty + tz * tz, cone = mu * normal;
    const T slip = squared > cone * cone ? cone / std::sqrt(squared + T(1e-30)) : T(1);
    const T share = distance < 0 ? slip : T(0);
    fx[i] = normal * nx + share * tx;
    fy[i] = normal * ny + share * ty;
    fz[i] = -(normal * nz + share * tz);
  }
}

template <class T>
void measure(const char* name) {
  constexpr int side = 200, count = side * side, repeats = 500;
  Points<T> points(count), out(count);
  for (int i = 0; i < count; ++i) {
    points.x[i] = T((i % side - side / 2) * 2e-5);
    points.y[i] = T((i / side - side / 2) * 2e-5);
    points.z[i] = T(-1e-3);
  }
  const T center[3] = {0, 0, T(0.018)}, v[3] = {T(0.01), 0, 0}, w[3] = {T(0.01), T(0.01), T(0.01)};
  double best = 1;
  for (int k = 0; k < repeats; ++k) {
    const auto start = std::chrono::steady_clock::now();
    read<T>(points, center, T(0.02), v, w, T(100), T(20), T(0.8), T(10), out);
    const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - start;
    best = std::min(best, taken.count());
  }
  std::printf("%s %.2f ns a marker\n", name, best / count * 1e9);
}

int main() {
  measure<double>("double");
  measure<float>("single");
}
