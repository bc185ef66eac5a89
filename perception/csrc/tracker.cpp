#include "tracker.hpp"

#include <stdexcept>

#include "curvature.hpp"
#include "deformed_shape.hpp"

namespace gelflow::perception {

namespace {
constexpr double min_quality = 0.35;  // of an accepted fit
constexpr double min_quality_undetected =
    0.55;                                      // of an accepted fit at an interpolated position without a detected dot
constexpr double uneven_light_quality = 0.92;  // quality / quality at rest below which a fit is improved by `EdgeFit`
constexpr double largest_unexplained =
    0.7;  // part of the edge that an accepted improvement may leave, relative to before
constexpr double min_quality_improved = 0.6;
constexpr double min_contrast_ratio = 0.35, max_contrast_ratio = 2.2;  // accepted contrast / contrast at rest
constexpr double min_response_ratio = 0.3;  // minimum response of a dot / median response at rest
constexpr double max_velocity = 0.25;       // in spacings per image; larger steps are jumps, without prediction
constexpr double trusted_quality = 0.8;     // from this quality on, a fit is not compared with the neighbours
constexpr double outlier_distance = 0.4;    // in spacings: limit for a fit of quality 1
constexpr float resolved_change = 0.05f;    // relative change of a shape that detected dots resolve
constexpr float refit_change = 0.01f;       // relative change of a shape for which a dot is fitted again
constexpr int relaxation_steps = 8;
constexpr int max_rest_images = 8;      // images averaged in the rest positions
constexpr double rest_coherence = 0.3;  // largest ratio of coherent to independent squared displacement at rest
constexpr double rest_outlier = 8;      // displacement of a marker that is not at rest, in medians of all markers

// Side of the fit window of a dot: wide enough to determine the background slope, without the neighbouring dots. A dot
// that is far longer than the others, as at the border of a wide-angle image, is not cut.
int window_size(double radius, double half_length, double spacing) {
  const auto packs = [](double length) {
    return int(std::ceil(std::min(double(Window::largest), length) / pack_size)) * pack_size;
  };
  const int most = int(0.85 * spacing / pack_size) * pack_size;
  return std::clamp(std::max(std::min(packs(3.8 * radius), most), packs(2.6 * half_length)), pack_size,
                    Window::largest);
}
// 0 without values.
template <class Number>
Number median(std::vector<Number> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + std::ptrdiff_t(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}
}  // namespace

Tracker::Tracker(TrackerSetup setup)
    : setup_(std::move(setup)),
      settings_{setup_.profile, setup_.radius, setup_.noise},
      edge_fit_(setup_.profile, median(setup_.contrast)),
      rest_quality_(setup_.rest.size()),
      plane_(setup_.width, setup_.height),
      detector_(setup_.width, setup_.height, setup_.radius, setup_.spacing, setup_.bright),
      assignment_(setup_.grid, setup_.spacing, setup_.width, setup_.height) {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m) {
    const DotShape& f = setup_.shape[m];
    const double area = std::abs(double(f.xx) * f.yy - double(f.xy) * f.yx);
    const Point half = {std::hypot(f.xy, f.yy) / area, std::hypot(f.xx, f.yx) / area};
    half_size_.push_back(0.9 * half);  // without the blurred edge
    const int window = window_size(setup_.radius, std::max(half.x, half.y), setup_.spacing);
    fit_basis_.push_back(
        fit_basis(setup_.profile, f, mask(m), setup_.contrast[m], window, setup_.rest[m], setup_.width, setup_.height));
    if (!(fit_basis_[m].pixels > 0)) setup_.visible[m] = 0;  // outside the image, or behind its mask
  }
  const auto determined = [](const FitBasis& basis) { return basis.pixels > 0; };
  if (std::none_of(fit_basis_.begin(), fit_basis_.end(), determined))
    throw std::invalid_argument("the dot profile does not determine the centre of a dot");
  positions_ = previous_ = setup_.rest;
  shape_ = next_shape_ = setup_.shape;
  velocity_.resize(n), displacement_.resize(n), relaxed_.resize(n), detection_offset_.resize(n);
  quality_.resize(n), contrasts_.resize(n);
  measured_.resize(n), filled_.resize(n);
  dots_.reserve(2 * n + 64);
}

void Tracker::start(const std::uint8_t* bgr) {
  extract_plane(bgr, plane_, setup_.channel);
  shape_ = setup_.shape;
  std::fill(rest_quality_.begin(), rest_quality_.end(), 0.0);
  anything_valid_ = false;
  for (std::size_t m = 0; m < setup_.rest.size(); ++m) {
    quality_[m] = 0;
    if (!setup_.visible[m]) continue;
    const DotFit found = fit(m, {setup_.rest[m], 12});
    quality_[m] = found.quality, contrasts_[m] = found.contrast;
    if (found.quality < min_quality || !is_inside(m, found.position)) {
      setup_.visible[m] = 0, quality_[m] = 0;
      continue;
    }
    setup_.rest[m] = found.position, setup_.contrast[m] = found.contrast;
    anything_valid_ = true;
  }
  positions_ = setup_.rest;
  rest_quality_ = quality_;
  rest_images_ = 1;
  std::fill(velocity_.begin(), velocity_.end(), Point{});
  detector_.detect(plane_, 0.0f, 4 * setup_.rest.size() + 64, dots_);
  std::vector<float> responses;
  std::fill(detection_offset_.begin(), detection_offset_.end(), Point{});
  for (const Dot& dot : dots_)
    for (std::size_t m = 0; m < setup_.rest.size(); ++m)
      if (setup_.visible[m] && squared(dot.position - setup_.rest[m]) < setup_.radius * setup_.radius) {
        responses.push_back(dot.response);
        detection_offset_[m] = setup_.rest[m] - dot.position;
      }
  if (responses.empty()) return;
  threshold_ = float(min_response_ratio) * median(std::move(responses));
  std::erase_if(dots_, [this](const Dot& dot) { return !(dot.response > threshold_); });
  assignment_.assign(dots_, positions_, velocity_, setup_.visible);  // so that it knows what is usually not assigned
}

void Tracker::track(const std::uint8_t* bgr) {
  extract_plane(bgr, plane_, setup_.channel);
  detector_.detect(plane_, threshold_, 2 * setup_.rest.size() + 64, dots_);
  previous_ = positions_;
  measure(assignment_.assign(dots_, previous_, velocity_, setup_.visible));
  anything_valid_ = std::any_of(measured_.begin(), measured_.end(), [](char k) { return k != 0; });
  if (rest_images_ > 0) refine_rest();
  const double limit = max_velocity * setup_.spacing;
  for (std::size_t m = 0; m < positions_.size(); ++m) {
    const Point v = positions_[m] - previous_[m];
    const double length = std::sqrt(squared(v));
    velocity_[m] = length <= limit ? v : Point{};
  }
}

void Tracker::refine(const std::uint8_t* bgr, const std::vector<Point>& positions, const std::vector<char>& wanted) {
  extract_plane(bgr, plane_, setup_.channel);
  positions_ = positions;
  std::fill(measured_.begin(), measured_.end(), char(1));  // inferred positions serve for shapes and curvature, too
  for (std::size_t m = 0; m < positions_.size(); ++m) {
    shape_[m] = deformed_shape(m);
    displacement_[m] = positions_[m] - setup_.rest[m];
  }
  const double limit = largest_refinement * setup_.radius;
  for (std::size_t m = 0; m < positions_.size(); ++m) relaxed_[m] = outline_offset(m);
  for (std::size_t m = 0; m < positions_.size(); ++m) {
    quality_[m] = 0, measured_[m] = 0;
    if (!wanted[m] || !setup_.visible[m]) continue;
    DotFit found = fit(m, {positions[m] + relaxed_[m], 8, true});
    found.position = found.position - relaxed_[m];
    if (squared(found.position - positions[m]) < limit * limit) accept(m, found, trusted_quality);
  }
  if (rest_images_ > 0) refine_rest();
}

// While nothing moves after the start, the rest positions become the mean over the images, which reduces the noise that
// the reference adds to each displacement. Noise is independent between markers and motion is common to neighbours: for
// independent noise, the squared mean of the eight neighbours is 0.12 times the squared deviation from it. A marker that
// is far from its rest position moves alone or is measured wrongly: its rest position stays, and without it the others
// must be at rest too.
void Tracker::refine_rest() {
  std::vector<float> squares;
  for (std::size_t m = 0; m < displacement_.size(); ++m) {
    displacement_[m] = positions_[m] - setup_.rest[m];
    if (measured_[m]) squares.push_back(float(squared(displacement_[m])));
  }
  filled_ = measured_;
  bool at_rest = !squares.empty() && rest_images_ < max_rest_images && is_incoherent();
  const double largest = squares.empty() ? 0 : rest_outlier * rest_outlier * median(std::move(squares));
  for (std::size_t m = 0; m < displacement_.size(); ++m)
    filled_[m] = measured_[m] && squared(displacement_[m]) <= largest;
  at_rest = at_rest && is_incoherent();
  rest_images_ = at_rest ? rest_images_ + 1 : 0;
  for (std::size_t m = 0; at_rest && m < displacement_.size(); ++m)
    if (filled_[m]) setup_.rest[m] = setup_.rest[m] + (1.0 / rest_images_) * displacement_[m];
}

// Whether the displacements of the `filled_` markers are independent of those of their neighbours, as noise is.
bool Tracker::is_incoherent() const {
  double coherent = 0, independent = 0;
  for (std::size_t m = 0; m < displacement_.size(); ++m) {
    Point mean;
    if (!filled_[m] || !neighbour_mean(int(m), mean)) continue;
    coherent += squared(mean), independent += squared(displacement_[m] - mean);
  }
  return coherent < rest_coherence * independent;
}

// Fits the assigned dots, then searches missing ones at interpolated positions, and infers the remaining markers.
void Tracker::measure(const std::vector<int>& dot_of) {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m) {
    measured_[m] = dot_of[m] >= 0;
    if (measured_[m]) positions_[m] = dots_[std::size_t(dot_of[m])].position + detection_offset_[m];
  }
  for (std::size_t m = 0; m < n; ++m) {
    const DotShape now = deformed_shape(m);
    if (differ(now, shape_[m], resolved_change)) shape_[m] = now;
  }
  for (std::size_t m = 0; m < n; ++m) {
    quality_[m] = 0;
    if (!measured_[m]) continue;
    measured_[m] = 0;
    if (setup_.visible[m]) accept(m, fit(m, {positions_[m], 8}), min_quality);
  }
  refit_deformed();  // first, since a fit with a wrong shape has a low quality
  const bool rejected = reject_outliers();
  if (std::none_of(measured_.begin(), measured_.end(), [](char k) { return k != 0; })) {
    positions_ = previous_;
    return;
  }
  if (rejected) refit_deformed();
  fill_missing();
  for (std::size_t m = 0; m < n; ++m) {
    if (measured_[m] || !setup_.visible[m]) continue;
    const DotFit found = fit(m, {positions_[m], 8});
    if (is_unoccupied(int(m), found.position)) accept(m, found, min_quality_undetected);
  }
  reject_outliers();
  correct_curvature();
  fill_missing();
  for (std::size_t m = 0; m < n; ++m) shape_[m] = deformed_shape(m);
}

// Fits a dot again where the shape by the fitted positions differs from that of its fit. The latter may be that of the
// last image, since detected dots do not resolve small changes.
void Tracker::refit_deformed() {
  for (std::size_t m = 0; m < positions_.size(); ++m) next_shape_[m] = deformed_shape(m);
  for (std::size_t m = 0; m < positions_.size(); ++m) {
    if (!measured_[m] || !differ(next_shape_[m], shape_[m], refit_change)) continue;
    shape_[m] = next_shape_[m];
    accept(m, fit(m, {positions_[m], 8}), min_quality);
  }
}

// Accepts a fit as the position of a marker if its quality reaches `threshold`.
void Tracker::accept(std::size_t marker, const DotFit& found, double threshold) {
  const double quality = accepted_quality(marker, found);
  if (quality < threshold) return;
  positions_[marker] = found.position, quality_[marker] = quality, measured_[marker] = 1;
}

DotShape Tracker::deformed_shape(std::size_t marker) const {
  return deformed({setup_.grid, setup_.rest, positions_, measured_}, marker, setup_.shape[marker], shape_[marker]);
}

// Moves the measured positions from the centres of the outlines to those of the dots.
void Tracker::correct_curvature() {
  for (std::size_t m = 0; m < displacement_.size(); ++m) displacement_[m] = positions_[m] - setup_.rest[m];
  for (std::size_t m = 0; m < displacement_.size(); ++m)
    if (measured_[m]) positions_[m] = positions_[m] - outline_offset(m);
}

Point Tracker::outline_offset(std::size_t marker) const {
  const GelMotion motion{setup_.grid, setup_.rest, displacement_, measured_};
  return curvature_offset(motion, marker, setup_.shape[marker], shape_[marker]);
}

// Whether two shapes differ by more than `change`, relative to the second.
bool Tracker::differ(const DotShape& one, const DotShape& two, float change) {
  const float limit = change * std::sqrt(two.xx * two.xx + two.xy * two.xy + two.yx * two.yx + two.yy * two.yy);
  return std::abs(one.xx - two.xx) > limit || std::abs(one.xy - two.xy) > limit || std::abs(one.yx - two.yx) > limit ||
         std::abs(one.yy - two.yy) > limit;
}

const DotMask* Tracker::mask(std::size_t marker) const {
  const int index = setup_.mask_of[marker];
  return index < 0 ? nullptr : &setup_.masks[std::size_t(index)];
}

DotFit Tracker::fit(std::size_t marker, const FitStart& start) const {
  const Point position = start.position;
  if (!(position.x > -setup_.radius && position.y > -setup_.radius && position.x < setup_.width + setup_.radius &&
        position.y < setup_.height + setup_.radius))
    return {position, 0, 0};
  const DotFit found = fit_dot(plane_, settings_, shape_[marker], mask(marker), fit_basis_[marker],
                               setup_.contrast[marker], setup_.tolerated[marker], start);
  if (!(found.quality > 0) || found.quality > uneven_light_quality * rest_quality_[marker]) return found;
  DotFit improved =
      edge_fit_.improve(plane_, shape_[marker], mask(marker), setup_.noise, setup_.tolerated[marker], found);
  const double ratio = improved.contrast / setup_.contrast[marker];
  const bool explains_more = 1 - improved.quality < largest_unexplained * (1 - found.quality);
  if (!explains_more || improved.quality < min_quality_improved || ratio < min_contrast_ratio ||
      ratio > max_contrast_ratio || squared(improved.position - found.position) > squared({setup_.radius, 0}))
    return found;
  improved.quality = found.quality;  // comparisons with the neighbours stay as strict as without the improvement
  return improved;
}

// Quality of a fit, 0 if the image border cuts the dot or its contrast differs too much from that at rest.
double Tracker::accepted_quality(std::size_t marker, const DotFit& found) const {
  const double ratio = found.contrast / setup_.contrast[marker];
  return is_inside(marker, found.position) && ratio > min_contrast_ratio && ratio < max_contrast_ratio ? found.quality
                                                                                                       : 0;
}

// Whether the dot of `marker` at `position` is entirely inside the image.
bool Tracker::is_inside(std::size_t marker, Point position) const {
  const Point half = half_size_[marker];
  return position.x > half.x && position.y > half.y && position.x < setup_.width - 1 - half.x &&
         position.y < setup_.height - 1 - half.y;
}

// Whether no neighbour of `marker` was measured at `position`.
bool Tracker::is_unoccupied(int marker, Point position) const {
  for (int direction = 0; direction < Grid::directions; ++direction) {
    const int other = setup_.grid.neighbour(marker, direction);
    if (other < 0 || !measured_[std::size_t(other)]) continue;
    if (squared(positions_[std::size_t(other)] - position) < 2 * setup_.radius * setup_.radius) return false;
  }
  return true;
}

// Rejects fits that differ from the extrapolation of the neighbours; the limit grows with the cube of the quality. True
// if there are any.
bool Tracker::reject_outliers() {
  bool any = false;
  for (std::size_t m = 0; m < displacement_.size(); ++m) displacement_[m] = positions_[m] - setup_.rest[m];
  filled_ = measured_;
  for (std::size_t m = 0; m < displacement_.size(); ++m) {
    Point predicted;
    double deviation;
    if (!filled_[m] || quality_[m] > trusted_quality || !extrapolate(int(m), predicted, deviation)) continue;
    const double limit = outlier_distance * quality_[m] * quality_[m] * quality_[m] * setup_.spacing + deviation;
    if (squared(displacement_[m] - predicted) > limit * limit) measured_[m] = 0, quality_[m] = 0, any = true;
  }
  return any;
}

// Predicts the displacement of `marker` as the median of the linear interpolations and extrapolations from pairs of
// filled neighbours in a line with it, exact for linear displacement fields. `deviation` is the median absolute
// deviation. False when there are fewer than three predictions.
bool Tracker::extrapolate(int marker, Point& predicted, double& deviation) const {
  std::array<double, 12> x, y;
  std::size_t n = 0;
  const auto filled = [&](int other) { return other >= 0 && filled_[std::size_t(other)]; };
  const auto step = [&](int other) { return displacement_[std::size_t(other)]; };
  const auto add = [&](Point p) { x[n] = p.x, y[n] = p.y, ++n; };
  for (int direction = 0; direction < Grid::directions; ++direction) {
    const int near = setup_.grid.neighbour(marker, direction), behind = setup_.grid.neighbour(marker, direction, 2);
    const int opposite = setup_.grid.neighbour(marker, direction, -1);
    if (!filled(near)) continue;
    if (direction % 2 == 0 && filled(opposite)) add(0.5 * (step(near) + step(opposite)));
    if (filled(behind)) add(2 * step(near) - step(behind));
  }
  if (n < 3) return false;
  const auto median = [n](std::array<double, 12>& values) {
    std::nth_element(values.begin(), values.begin() + n / 2, values.begin() + n);
    return values[n / 2];
  };
  predicted = {median(x), median(y)};
  for (std::size_t i = 0; i < n; ++i) x[i] = std::abs(x[i] - predicted.x), y[i] = std::abs(y[i] - predicted.y);
  deviation = std::hypot(median(x), median(y));
  return true;
}

// Mean displacement of the filled neighbours; axis neighbours have twice the weight of diagonal ones. False when there
// are none.
bool Tracker::neighbour_mean(int marker, Point& mean) const {
  Point sum{};
  double weight = 0;
  for (int direction = 0; direction < Grid::directions; ++direction) {
    const int other = setup_.grid.neighbour(marker, direction);
    if (other < 0 || filled_[std::size_t(other)] != 1) continue;
    const double share = direction < Grid::axis_directions ? 2 : 1;
    sum = sum + share * displacement_[std::size_t(other)];
    weight += share;
  }
  if (weight == 0) return false;
  mean = (1 / weight) * sum;
  return true;
}

// Infers the positions of markers that were not measured: fills their displacements outwards from measured neighbours,
// then relaxes them towards the mean of their neighbours.
void Tracker::fill_missing() {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m) displacement_[m] = positions_[m] - setup_.rest[m];
  filled_ = measured_;
  const auto pass = [&](bool outwards) {
    bool changed = false;
    for (std::size_t m = 0; m < n; ++m) {
      relaxed_[m] = displacement_[m];
      if (measured_[m] || (outwards && filled_[m])) continue;
      if (!neighbour_mean(int(m), relaxed_[m])) continue;
      if (!filled_[m]) filled_[m] = 2, changed = true;  // used from the next pass on
    }
    displacement_.swap(relaxed_);
    for (char& f : filled_) f = char(f != 0);
    return changed;
  };
  while (pass(true)) {
  }
  for (int i = 0; i < relaxation_steps; ++i) pass(false);
  for (std::size_t m = 0; m < n; ++m)
    if (!measured_[m]) positions_[m] = setup_.rest[m] + displacement_[m];
}

}  // namespace gelflow::perception
