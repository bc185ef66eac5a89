// Dots in a plane, by local contrast, to about a fifth of a pixel.
//
// The plane is first made smaller until a dot's radius is about 2 pixels: a dot's place needs no more to be told from
// its neighbours', and the time no longer depends on the image's size. With m the mean over a box about as wide as the
// dots' spacing (a regular grid then leaves no ripple in it), and d the mean over a box inside the dot,
//
//   response = ± (d − m) / (m + 8),   + for bright dots, − for dark ones,
//
// so that light that changes slowly drops out and dim corners count as much; the 8 grey levels keep the noise of black
// ones down. A dot is a local maximum of it; a parabola through its neighbours gives the place.
#pragma once

#include "image.hpp"

namespace gelflow::perception {

struct Dot {
  Point place;
  float response;
};

class Contrast {
 public:
  Contrast(int width, int height, double radius, double spacing, bool bright)
      : shrink_(std::clamp(int(radius / 2 + 0.5), 1, std::min(width, height))),
        width_(width / shrink_),
        height_(height / shrink_),
        inner_(std::max(1, int(0.75 * radius / shrink_))),
        outer_(std::max(inner_ + 1, int(0.5 * spacing / shrink_ + 0.5))),
        apart_(std::max(1, int(0.3 * spacing / shrink_))),
        bright_(bright),
        stride_(width_ + 2 * outer_ + 8),
        small_(std::size_t(stride_) * (height_ + 2 * outer_)),
        columns_(2 * std::size_t(stride_)),
        response_(std::size_t(width_) * height_),
        marks_(std::size_t(width_) + 8) {
    found_.reserve(response_.size());
  }

  // All local maxima above `least`, at most `most` of them, the strongest, in the order of the image's lines.
  void find(const Plane& plane, float least, std::size_t most, std::vector<Dot>& dots);

 private:
  void reduce(const Plane& plane);
  void respond();
  bool highest(int x, int y) const;

  int shrink_, width_, height_;  // of the smaller picture
  int inner_, outer_;            // the boxes are 2 inner + 1 and 2 outer + 1 wide
  int apart_;                    // two dots are at least so far apart
  bool bright_;
  int stride_;
  std::vector<std::int32_t> small_;    // sums of shrink × shrink pixels, mirrored by `outer` beyond each side
  std::vector<std::int32_t> columns_;  // sums over the boxes' height, inner then outer
  std::vector<float> response_;
  std::vector<std::uint8_t> marks_;  // pixels of a line that may be peaks
  std::vector<Dot> found_;
};

// Sums of shrink × shrink pixels, one line of them. A block is unrolled, which makes it fast, for the usual sizes.
template <int shrink>
GELFLOW_INLINE void add_block_of(const std::uint8_t* __restrict pixels, int stride, std::int32_t* __restrict out,
                                 int width) {
  for (int x = 0; x < width; ++x) {
    std::int32_t sum = 0;
    for (int i = 0; i < shrink; ++i)
      for (int j = 0; j < shrink; ++j) sum += pixels[i * stride + x * shrink + j];
    out[x] = sum;
  }
}

GELFLOW_CLONES inline void add_block(const std::uint8_t* __restrict pixels, int stride, int shrink,
                                     std::int32_t* __restrict out, int width) {
  switch (shrink) {
    case 1:
      return add_block_of<1>(pixels, stride, out, width);
    case 2:
      return add_block_of<2>(pixels, stride, out, width);
    case 3:
      return add_block_of<3>(pixels, stride, out, width);
    case 4:
      return add_block_of<4>(pixels, stride, out, width);
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

// One line of the response from the sums over the boxes' columns; both begin `outer` before the line.
GELFLOW_CLONES inline void respond_line(const std::int32_t* __restrict inner_columns,
                                        const std::int32_t* __restrict outer_columns, int inner, int outer, float sign,
                                        float dark, float* __restrict out, int width) {
  constexpr int block = 64;
  const float inner_share = 1.0f / float((2 * inner + 1) * (2 * inner + 1));
  const float outer_share = 1.0f / float((2 * outer + 1) * (2 * outer + 1));
  for (int start = 0; start < width; start += block) {
    const int n = std::min(block, width - start);
    std::int32_t near[block] = {}, wide[block] = {};
    for (int j = 0; j <= 2 * inner; ++j)
      for (int x = 0; x < n; ++x) near[x] += inner_columns[start + x + outer - inner + j];
    for (int j = 0; j <= 2 * outer; ++j)
      for (int x = 0; x < n; ++x) wide[x] += outer_columns[start + x + j];
    for (int x = 0; x < n; ++x) {
      const float mean = outer_share * float(wide[x]);
      out[start + x] = sign * (inner_share * float(near[x]) - mean) / (mean + dark);
    }
  }
}

// Which pixels of a line stand out by more than `least`, and are not less than their four neighbours.
GELFLOW_CLONES inline void mark_line(const float* __restrict above, const float* __restrict line,
                                     const float* __restrict below, float least, std::uint8_t* __restrict marks,
                                     int width) {
  marks[0] = line[0] > least, marks[width - 1] = line[width - 1] > least;
  for (int x = 1; x < width - 1; ++x)
    marks[x] = (line[x] > least) & (line[x] >= line[x - 1]) & (line[x] >= line[x + 1]) & (line[x] >= above[x]) &
               (line[x] >= below[x]);
}

inline void Contrast::reduce(const Plane& plane) {
  for (int y = 0; y < height_; ++y) {
    std::int32_t* line = &small_[std::size_t(y + outer_) * stride_];
    add_block(plane.row(y * shrink_), plane.stride, shrink_, line + outer_, width_);
    for (int i = 1; i <= outer_; ++i) {
      line[outer_ - i] = line[outer_ + std::min(i, width_ - 1)];
      line[outer_ + width_ - 1 + i] = line[outer_ + std::max(width_ - 1 - i, 0)];
    }
  }
  const auto line = [&](int y) { return &small_[std::size_t(y + outer_) * stride_]; };
  for (int i = 1; i <= outer_; ++i) {
    std::copy_n(line(std::min(i, height_ - 1)), stride_, line(-i));
    std::copy_n(line(std::max(height_ - 1 - i, 0)), stride_, line(height_ - 1 + i));
  }
}

inline void Contrast::respond() {
  const int wide = width_ + 2 * outer_;
  std::int32_t *near = columns_.data(), *far = near + stride_;
  std::fill(columns_.begin(), columns_.end(), 0);
  const auto line = [&](int y) { return &small_[std::size_t(y + outer_) * stride_]; };
  for (int y = -inner_; y < inner_; ++y) add_line(line(y), near, wide, 1);
  for (int y = -outer_; y < outer_; ++y) add_line(line(y), far, wide, 1);
  for (int y = 0; y < height_; ++y) {
    add_line(line(y + inner_), near, wide, 1);
    add_line(line(y + outer_), far, wide, 1);
    respond_line(near, far, inner_, outer_, bright_ ? 1.0f : -1.0f, float(8 * shrink_ * shrink_),
                 &response_[std::size_t(y) * width_], width_);
    add_line(line(y - inner_), near, wide, -1);
    add_line(line(y - outer_), far, wide, -1);
  }
}

// Of equal neighbours the first one, in the order of lines, is the maximum.
inline bool Contrast::highest(int x, int y) const {
  const float here = response_[std::size_t(y) * width_ + x];
  for (int v = std::max(y - apart_, 0); v <= std::min(y + apart_, height_ - 1); ++v)
    for (int u = std::max(x - apart_, 0); u <= std::min(x + apart_, width_ - 1); ++u) {
      if (u == x && v == y) continue;
      const float there = response_[std::size_t(v) * width_ + u];
      const bool before = v < y || (v == y && u < x);
      if (before ? there >= here : there > here) return false;
    }
  return true;
}

// The top of the parabola through three neighbours, in pixels from the middle one.
inline float parabola_top(float left, float middle, float right) {
  const float bend = left - 2 * middle + right;
  return bend < -1e-9f ? std::clamp(0.5f * (left - right) / bend, -0.5f, 0.5f) : 0.0f;
}

inline void Contrast::find(const Plane& plane, float least, std::size_t most, std::vector<Dot>& dots) {
  reduce(plane);
  respond();
  found_.clear();
  for (int y = 0; y < height_; ++y) {
    const float* line = &response_[std::size_t(y) * width_];
    mark_line(y > 0 ? line - width_ : line, line, y + 1 < height_ ? line + width_ : line, least, marks_.data(), width_);
    for (int x = 0; x < width_; ++x) {
      if (x % 8 == 0) {  // most pixels are no peaks: eight at once
        std::uint64_t eight;
        std::memcpy(&eight, &marks_[std::size_t(x)], 8);
        if (eight == 0) {
          x += 7;
          continue;
        }
      }
      if (!marks_[std::size_t(x)] || !highest(x, y)) continue;
      const bool edge_x = x == 0 || x == width_ - 1, edge_y = y == 0 || y == height_ - 1;
      const float dx = edge_x ? 0.0f : parabola_top(line[x - 1], line[x], line[x + 1]);
      const float dy = edge_y ? 0.0f : parabola_top(line[x - width_], line[x], line[x + width_]);
      found_.push_back({{(x + dx + 0.5) * shrink_ - 0.5, (y + dy + 0.5) * shrink_ - 0.5}, line[x]});
    }
  }
  if (found_.size() > most) {
    const auto stronger = [](const Dot& a, const Dot& b) {
      return a.response != b.response ? a.response > b.response
                                      : (a.place.y != b.place.y ? a.place.y < b.place.y : a.place.x < b.place.x);
    };
    std::nth_element(found_.begin(), found_.begin() + std::ptrdiff_t(most), found_.end(), stronger);
    found_.resize(most);
    std::sort(found_.begin(), found_.end(), [](const Dot& a, const Dot& b) {
      return a.place.y != b.place.y ? a.place.y < b.place.y : a.place.x < b.place.x;
    });
  }
  dots.assign(found_.begin(), found_.end());
}

}  // namespace gelflow::perception
