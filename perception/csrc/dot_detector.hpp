// Detects dots by local contrast, to about a fifth of a pixel.
//
// The image is first downsampled until the radius of a dot is about 2 pixels: this resolution separates neighbouring
// dots, and makes the cost independent of the image size. With m the mean over a box about as wide as the dot spacing (a
// regular grid then leaves no ripple in m), and d the mean over a box inside the dot, the response is
//
//   response = ± (d − m) / (m + 8),   + for bright dots, − for dark ones,
//
// which is insensitive to slow illumination changes and to the brightness of the surroundings; the 8 grey levels
// suppress the noise of black regions. A dot is a local maximum of the response, refined by a parabola.
#pragma once

#include "image.hpp"

namespace gelflow::perception {

struct Dot {
  Point position;
  float response;
};

class DotDetector {
 public:
  DotDetector(int width, int height, double radius, double spacing, bool bright)
      : shrink_(std::clamp(int(radius / 2 + 0.5), 1, std::min(width, height))),
        width_(width / shrink_),
        height_(height / shrink_),
        inner_(std::max(1, int(0.75 * radius / shrink_))),
        outer_(std::max(inner_ + 1, int(0.5 * spacing / shrink_ + 0.5))),
        min_distance_(std::max(1, int(0.3 * spacing / shrink_))),
        bright_(bright),
        stride_(width_ + 2 * outer_ + 8),
        reduced_(std::size_t(stride_) * (height_ + 2 * outer_)),
        column_sums_(2 * std::size_t(stride_)),
        response_(std::size_t(width_) * height_),
        mask_(std::size_t(width_) + 8) {
    candidates_.reserve(response_.size());
  }

  // The `max_count` strongest local maxima above `threshold`, in the order of the image lines.
  void detect(const Plane& plane, float threshold, std::size_t max_count, std::vector<Dot>& dots);

 private:
  void downsample(const Plane& plane);
  void compute_response();
  void collect_candidates(float threshold);
  bool is_local_maximum(int x, int y) const;

  int shrink_, width_, height_;  // of the downsampled image
  int inner_, outer_;            // the sides of the boxes are 2 inner + 1 and 2 outer + 1
  int min_distance_;             // minimum distance of two dots
  bool bright_;
  int stride_;
  std::vector<std::int32_t> reduced_;      // sums of shrink × shrink pixels, mirrored by `outer` at each side
  std::vector<std::int32_t> column_sums_;  // column sums of the inner box, then of the outer box
  std::vector<float> response_;
  std::vector<std::uint8_t> mask_;  // candidate pixels of a line
  std::vector<Dot> candidates_;
};

// One line of sums over shrink × shrink pixels. Templates unroll the usual sizes.
template <int shrink>
GELFLOW_INLINE void sum_blocks_of(const std::uint8_t* __restrict pixels, int stride, std::int32_t* __restrict out,
                                  int width) {
  for (int x = 0; x < width; ++x) {
    std::int32_t sum = 0;
    for (int i = 0; i < shrink; ++i)
      for (int j = 0; j < shrink; ++j) sum += pixels[i * stride + x * shrink + j];
    out[x] = sum;
  }
}

GELFLOW_CLONES inline void sum_blocks(const std::uint8_t* __restrict pixels, int stride, int shrink,
                                      std::int32_t* __restrict out, int width) {
  switch (shrink) {
    case 1:
      return sum_blocks_of<1>(pixels, stride, out, width);
    case 2:
      return sum_blocks_of<2>(pixels, stride, out, width);
    case 3:
      return sum_blocks_of<3>(pixels, stride, out, width);
    case 4:
      return sum_blocks_of<4>(pixels, stride, out, width);
  }
  for (int x = 0; x < width; ++x) {
    std::int32_t sum = 0;
    for (int i = 0; i < shrink; ++i)
      for (int j = 0; j < shrink; ++j) sum += pixels[i * stride + x * shrink + j];
    out[x] = sum;
  }
}

GELFLOW_CLONES inline void add_line(const std::int32_t* __restrict line, std::int32_t* __restrict sums, int width,
                                    int sign) {
  for (int x = 0; x < width; ++x) sums[x] += sign * line[x];
}

// One line of the response from the column sums of both boxes, which start `outer` pixels before the line.
GELFLOW_CLONES inline void response_line(const std::int32_t* __restrict inner_columns,
                                         const std::int32_t* __restrict outer_columns, int inner, int outer, float sign,
                                         float offset, float* __restrict out, int width) {
  constexpr int block = 64;
  const float inner_share = 1.0f / float((2 * inner + 1) * (2 * inner + 1));
  const float outer_share = 1.0f / float((2 * outer + 1) * (2 * outer + 1));
  for (int start = 0; start < width; start += block) {
    const int n = std::min(block, width - start);
    std::int32_t inner_sums[block] = {}, outer_sums[block] = {};
    for (int j = 0; j <= 2 * inner; ++j)
      for (int x = 0; x < n; ++x) inner_sums[x] += inner_columns[start + x + outer - inner + j];
    for (int j = 0; j <= 2 * outer; ++j)
      for (int x = 0; x < n; ++x) outer_sums[x] += outer_columns[start + x + j];
    for (int x = 0; x < n; ++x) {
      const float mean = outer_share * float(outer_sums[x]);
      out[start + x] = sign * (inner_share * float(inner_sums[x]) - mean) / (mean + offset);
    }
  }
}

// Marks the pixels of a line above `threshold` that are not smaller than their four neighbours.
GELFLOW_CLONES inline void mask_line(const float* __restrict above, const float* __restrict line,
                                     const float* __restrict below, float threshold, std::uint8_t* __restrict mask,
                                     int width) {
  mask[0] = line[0] > threshold, mask[width - 1] = line[width - 1] > threshold;
  for (int x = 1; x < width - 1; ++x)
    mask[x] = (line[x] > threshold) & (line[x] >= line[x - 1]) & (line[x] >= line[x + 1]) & (line[x] >= above[x]) &
              (line[x] >= below[x]);
}

inline void DotDetector::downsample(const Plane& plane) {
  for (int y = 0; y < height_; ++y) {
    std::int32_t* line = &reduced_[std::size_t(y + outer_) * stride_];
    sum_blocks(plane.row(y * shrink_), plane.stride, shrink_, line + outer_, width_);
    for (int i = 1; i <= outer_; ++i) {
      line[outer_ - i] = line[outer_ + std::min(i, width_ - 1)];
      line[outer_ + width_ - 1 + i] = line[outer_ + std::max(width_ - 1 - i, 0)];
    }
  }
  const auto line = [&](int y) { return &reduced_[std::size_t(y + outer_) * stride_]; };
  for (int i = 1; i <= outer_; ++i) {
    std::copy_n(line(std::min(i, height_ - 1)), stride_, line(-i));
    std::copy_n(line(std::max(height_ - 1 - i, 0)), stride_, line(height_ - 1 + i));
  }
}

inline void DotDetector::compute_response() {
  const int padded_width = width_ + 2 * outer_;
  std::int32_t *inner_sums = column_sums_.data(), *outer_sums = inner_sums + stride_;
  std::fill(column_sums_.begin(), column_sums_.end(), 0);
  const auto line = [&](int y) { return &reduced_[std::size_t(y + outer_) * stride_]; };
  for (int y = -inner_; y < inner_; ++y) add_line(line(y), inner_sums, padded_width, 1);
  for (int y = -outer_; y < outer_; ++y) add_line(line(y), outer_sums, padded_width, 1);
  for (int y = 0; y < height_; ++y) {
    add_line(line(y + inner_), inner_sums, padded_width, 1);
    add_line(line(y + outer_), outer_sums, padded_width, 1);
    response_line(inner_sums, outer_sums, inner_, outer_, bright_ ? 1.0f : -1.0f, float(8 * shrink_ * shrink_),
                  &response_[std::size_t(y) * width_], width_);
    add_line(line(y - inner_), inner_sums, padded_width, -1);
    add_line(line(y - outer_), outer_sums, padded_width, -1);
  }
}

// Of equal responses the first one in scan order is the maximum.
inline bool DotDetector::is_local_maximum(int x, int y) const {
  const float here = response_[std::size_t(y) * width_ + x];
  for (int v = std::max(y - min_distance_, 0); v <= std::min(y + min_distance_, height_ - 1); ++v)
    for (int u = std::max(x - min_distance_, 0); u <= std::min(x + min_distance_, width_ - 1); ++u) {
      if (u == x && v == y) continue;
      const float there = response_[std::size_t(v) * width_ + u];
      const bool before = v < y || (v == y && u < x);
      if (before ? there >= here : there > here) return false;
    }
  return true;
}

// Vertex of the parabola through three neighbouring values, relative to the middle one [px].
inline float parabola_top(float left, float middle, float right) {
  const float curvature = left - 2 * middle + right;
  return curvature < -1e-9f ? std::clamp(0.5f * (left - right) / curvature, -0.5f, 0.5f) : 0.0f;
}

inline void DotDetector::collect_candidates(float threshold) {
  candidates_.clear();
  for (int y = 0; y < height_; ++y) {
    const float* line = &response_[std::size_t(y) * width_];
    mask_line(y > 0 ? line - width_ : line, line, y + 1 < height_ ? line + width_ : line, threshold, mask_.data(),
              width_);
    for (int x = 0; x < width_; ++x) {
      if (x % 8 == 0) {  // few pixels are candidates: test eight at once
        std::uint64_t eight;
        std::memcpy(&eight, &mask_[std::size_t(x)], 8);
        if (eight == 0) {
          x += 7;
          continue;
        }
      }
      if (!mask_[std::size_t(x)] || !is_local_maximum(x, y)) continue;
      const bool edge_x = x == 0 || x == width_ - 1, edge_y = y == 0 || y == height_ - 1;
      const float dx = edge_x ? 0.0f : parabola_top(line[x - 1], line[x], line[x + 1]);
      const float dy = edge_y ? 0.0f : parabola_top(line[x - width_], line[x], line[x + width_]);
      candidates_.push_back({{(x + dx + 0.5) * shrink_ - 0.5, (y + dy + 0.5) * shrink_ - 0.5}, line[x]});
    }
  }
}

inline void DotDetector::detect(const Plane& plane, float threshold, std::size_t max_count, std::vector<Dot>& dots) {
  downsample(plane);
  compute_response();
  collect_candidates(threshold);
  if (candidates_.size() > max_count) {
    const auto stronger = [](const Dot& a, const Dot& b) {
      if (a.response != b.response) return a.response > b.response;
      return a.position.y != b.position.y ? a.position.y < b.position.y : a.position.x < b.position.x;
    };
    std::nth_element(candidates_.begin(), candidates_.begin() + std::ptrdiff_t(max_count), candidates_.end(), stronger);
    candidates_.resize(max_count);
    std::sort(candidates_.begin(), candidates_.end(), [](const Dot& a, const Dot& b) {
      return a.position.y != b.position.y ? a.position.y < b.position.y : a.position.x < b.position.x;
    });
  }
  dots.assign(candidates_.begin(), candidates_.end());
}

}  // namespace gelflow::perception
