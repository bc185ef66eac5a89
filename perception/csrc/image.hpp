// One channel of a camera image with a margin around it.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "clones.hpp"

namespace gelflow::perception {

struct Point {
  double x = 0, y = 0;  // right, down [px]
};
GELFLOW_INLINE Point operator+(Point a, Point b) { return {a.x + b.x, a.y + b.y}; }
GELFLOW_INLINE Point operator-(Point a, Point b) { return {a.x - b.x, a.y - b.y}; }
GELFLOW_INLINE Point operator*(double s, Point a) { return {s * a.x, s * a.y}; }
GELFLOW_INLINE double squared(Point a) { return a.x * a.x + a.y * a.y; }

// The channel in which dots are detected, in the order of PLANES in detect.py.
enum class Channel { grey, value, blue, green, red, chroma };

struct Plane {
  // Reads up to `margin` pixels beyond each side are allowed; the values there are unspecified.
  static constexpr int margin = 96;
  int width, height, stride;
  std::vector<std::uint8_t> data;

  Plane(int width, int height)
      : width(width), height(height), stride(width + 2 * margin), data(std::size_t(stride) * (height + 2 * margin)) {}
  const std::uint8_t* row(int y) const { return data.data() + std::size_t(y + margin) * stride + margin; }
  std::uint8_t* row(int y) { return data.data() + std::size_t(y + margin) * stride + margin; }
};

// Extracts the channel of one line of B G R pixels. The weights of grey are those of the JPEG luminance in 1/256.
GELFLOW_CLONES inline void extract_line(const std::uint8_t* __restrict bgr, std::uint8_t* __restrict out, int width,
                                        Channel channel) {
  switch (channel) {
    case Channel::grey:
      for (int x = 0; x < width; ++x)
        out[x] = std::uint8_t((29 * bgr[3 * x] + 150 * bgr[3 * x + 1] + 77 * bgr[3 * x + 2] + 128) >> 8);
      break;
    case Channel::blue:
    case Channel::green:
    case Channel::red:
      bgr += int(channel) - int(Channel::blue);
      for (int x = 0; x < width; ++x) out[x] = bgr[3 * x];
      break;
    case Channel::value:
    case Channel::chroma:
      for (int x = 0; x < width; ++x) {
        const std::uint8_t b = bgr[3 * x], g = bgr[3 * x + 1], r = bgr[3 * x + 2];
        const std::uint8_t high = std::max(std::max(b, g), r), low = std::min(std::min(b, g), r);
        out[x] = channel == Channel::value ? high : std::uint8_t(high - low);
      }
      break;
  }
}

inline void extract_plane(const std::uint8_t* bgr, Plane& plane, Channel channel) {
  for (int y = 0; y < plane.height; ++y)
    extract_line(bgr + std::size_t(3) * plane.width * y, plane.row(y), plane.width, channel);
}

}  // namespace gelflow::perception
