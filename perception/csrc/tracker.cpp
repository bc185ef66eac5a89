#include "tracker.hpp"

#include <stdexcept>

namespace gelflow::perception {

namespace {
constexpr double least_quality = 0.35;       // of a fit that is believed
constexpr double least_quality_lost = 0.55;  // the same where no dot stood out, only the neighbours say where to look
constexpr double weakest = 0.35, strongest = 2.2;  // contrast that is believed, against that at rest
constexpr double faintest = 0.3;                   // response of a dot, against the middle one at rest
constexpr double fastest = 0.25;      // of the spacing per image: more is taken for a jump, not for a velocity
constexpr double unquestioned = 0.8;  // quality from which on the neighbours are not asked
constexpr double stray = 0.4;  // of the spacing: how far from its neighbours' word a perfect fit would be believed
constexpr float oval_change = 0.1f;  // of an oval's curvature, that the coarse places of dots show for certain
constexpr int relaxations = 8;
constexpr int most_at_rest = 8;      // images that make the reference, if nothing moves before
constexpr double rest_smooth = 0.3;  // largest share of what neighbours have in common, in the squares of noise

// As wide as makes the light's slope certain, but without the neighbours' dots.
int window_size(double radius, double spacing) {
  const int wanted = int(std::ceil(3.8 * radius / lanes)) * lanes, most = int(0.85 * spacing / lanes) * lanes;
  return std::clamp(wanted, lanes, std::clamp(most, lanes, Window::largest));
}
}  // namespace

Tracker::Tracker(Setup setup)
    : setup_(std::move(setup)),
      settings_{setup_.shape, window_size(setup_.radius, setup_.spacing), setup_.radius, setup_.noise},
      inverse_(setup_.rest.size()),
      plane_(setup_.width, setup_.height),
      contrast_(setup_.width, setup_.height, setup_.radius, setup_.spacing, setup_.bright),
      follow_(setup_.grid, setup_.spacing) {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m)
    if (!normal_inverse(setup_.shape, setup_.oval[m], setup_.contrast[m], settings_.window, inverse_[m]))
      throw std::invalid_argument("the shape of a dot does not tell where its centre is");
  for (const Oval& q : setup_.oval) {  // half the ellipse's width and height, less what a blurred edge may lack
    const double area = double(q.xx) * q.yy - double(q.xy) * q.xy;
    half_.push_back({0.9 * std::sqrt(q.yy / area), 0.9 * std::sqrt(q.xx / area)});
  }
  places_ = before_ = setup_.rest;
  oval_ = setup_.oval;
  velocity_.resize(n), steps_.resize(n), next_.resize(n), offset_.resize(n);
  quality_.resize(n), contrasts_.resize(n);
  known_.resize(n), filled_.resize(n), expected_.resize(n);
  dots_.reserve(2 * n + 64);
}

void Tracker::start(const std::uint8_t* bgr) {
  take_plane(bgr, plane_, setup_.channel);
  oval_ = setup_.oval;
  anything_valid_ = false;
  for (std::size_t m = 0; m < setup_.rest.size(); ++m) {
    quality_[m] = 0;
    if (!setup_.seen[m]) continue;
    const Fit found = fit(m, setup_.rest[m], 12);
    quality_[m] = found.quality, contrasts_[m] = found.contrast;
    if (found.quality < least_quality || !is_inside(m, found.place)) {
      setup_.seen[m] = 0, quality_[m] = 0;
      continue;
    }
    setup_.rest[m] = found.place, setup_.contrast[m] = found.contrast;
    anything_valid_ = true;
  }
  places_ = setup_.rest;
  at_rest_ = 1;
  std::fill(velocity_.begin(), velocity_.end(), Point{});
  contrast_.find(plane_, 0.0f, 4 * setup_.rest.size() + 64, dots_);
  std::vector<float> strength;
  std::fill(offset_.begin(), offset_.end(), Point{});
  for (const Dot& dot : dots_)
    for (std::size_t m = 0; m < setup_.rest.size(); ++m)
      if (setup_.seen[m] && squared(dot.place - setup_.rest[m]) < setup_.radius * setup_.radius) {
        strength.push_back(dot.response);
        offset_[m] = setup_.rest[m] - dot.place;
      }
  if (strength.empty()) return;
  const auto middle = strength.begin() + std::ptrdiff_t(strength.size() / 2);
  std::nth_element(strength.begin(), middle, strength.end());
  least_ = float(faintest) * *middle;
}

void Tracker::track(const std::uint8_t* bgr) {
  take_plane(bgr, plane_, setup_.channel);
  contrast_.find(plane_, least_, 2 * setup_.rest.size() + 64, dots_);
  before_ = places_;
  for (std::size_t m = 0; m < places_.size(); ++m)
    expected_[m] = char(setup_.seen[m] && is_inside(m, before_[m] + velocity_[m]));
  measure(follow_.assign(dots_, before_, velocity_, expected_));
  anything_valid_ = std::any_of(known_.begin(), known_.end(), [](char k) { return k != 0; });
  if (at_rest_ > 0) refine_rest();
  const double most = fastest * setup_.spacing;
  for (std::size_t m = 0; m < places_.size(); ++m) {
    const Point v = places_[m] - before_[m];
    const double length = std::sqrt(squared(v));
    velocity_[m] = length <= most ? v : Point{};
  }
}

// As long as nothing has moved since the start, the reference becomes the mean of all images: one image's noise alone
// would stay in every displacement. Noise differs from marker to marker, motion is shared by neighbours: of independent
// noise, the mean of the eight around a marker has 0.12 times the squares of what differs from it.
void Tracker::refine_rest() {
  filled_ = known_;
  double shared = 0, own = 0;
  for (std::size_t m = 0; m < steps_.size(); ++m) steps_[m] = places_[m] - setup_.rest[m];
  for (std::size_t m = 0; m < steps_.size(); ++m) {
    Point mean;
    if (!known_[m] || !around(int(m), mean)) continue;
    shared += squared(mean), own += squared(steps_[m] - mean);
  }
  if (!(shared < rest_smooth * own) || at_rest_ == most_at_rest) {
    at_rest_ = 0;
    return;
  }
  ++at_rest_;
  for (std::size_t m = 0; m < steps_.size(); ++m)
    if (known_[m]) setup_.rest[m] = setup_.rest[m] + (1.0 / at_rest_) * steps_[m];
}

// Fits the dots that markers own, then looks for the others where their neighbours say; guesses what is left.
void Tracker::measure(const std::vector<int>& owner) {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m) {
    known_[m] = owner[m] >= 0;
    if (known_[m]) places_[m] = dots_[std::size_t(owner[m])].place + offset_[m];
  }
  for (std::size_t m = 0; m < n; ++m) {
    const Oval now = stretched(m);
    if (differ(now, oval_[m])) oval_[m] = now;
  }
  for (std::size_t m = 0; m < n; ++m) {
    quality_[m] = 0;
    if (!known_[m]) continue;
    known_[m] = 0;
    if (setup_.seen[m]) accept(m, fit(m, places_[m], 8), least_quality);
  }
  drop_strays();
  if (std::none_of(known_.begin(), known_.end(), [](char k) { return k != 0; })) {
    places_ = before_;
    return;
  }
  spread();
  for (std::size_t m = 0; m < n; ++m) {
    if (known_[m] || !setup_.seen[m]) continue;
    const Fit found = fit(m, places_[m], 8);
    if (is_free(int(m), found.place)) accept(m, found, least_quality_lost);
  }
  drop_strays();
  spread();
  for (std::size_t m = 0; m < n; ++m) oval_[m] = stretched(m);
}

// Takes a fit as the marker's place when enough of the dot's edge was seen.
void Tracker::accept(std::size_t marker, const Fit& found, double least) {
  const double quality = believed(marker, found);
  if (quality < least) return;
  places_[marker] = found.place, quality_[marker] = quality, known_[marker] = 1;
}

// The oval of a marker's dot, which is stretched and turned as the gel around it is: by G = L₀ L⁻¹, where the columns of
// L are the ways between its neighbours on either side, and L₀ those at rest, Q becomes GᵀQG.
Oval Tracker::stretched(std::size_t marker) const {
  Point now[2], rest[2];
  for (int axis = 0; axis < 2; ++axis) {
    std::size_t ends[2];
    for (int side = 0; side < 2; ++side) {
      const int other = setup_.grid.neighbour(int(marker), (axis ? Grid::downwards : Grid::to_the_right) + side);
      ends[side] = other < 0 ? marker : std::size_t(other);
      if (!known_[ends[side]]) return oval_[marker];
    }
    now[axis] = places_[ends[0]] - places_[ends[1]];
    rest[axis] = setup_.rest[ends[0]] - setup_.rest[ends[1]];
  }
  const double area = now[0].x * now[1].y - now[0].y * now[1].x;
  if (!(area > 0.3 * (rest[0].x * rest[1].y - rest[0].y * rest[1].x))) return oval_[marker];
  const double xx = (rest[0].x * now[1].y - rest[1].x * now[0].y) / area;
  const double xy = (rest[1].x * now[0].x - rest[0].x * now[1].x) / area;
  const double yx = (rest[0].y * now[1].y - rest[1].y * now[0].y) / area;
  const double yy = (rest[1].y * now[0].x - rest[0].y * now[1].x) / area;
  const Oval& q = setup_.oval[marker];
  return {float(q.xx * xx * xx + 2 * q.xy * xx * yx + q.yy * yx * yx),
          float(q.xx * xx * xy + q.xy * (xx * yy + xy * yx) + q.yy * yx * yy),
          float(q.xx * xy * xy + 2 * q.xy * xy * yy + q.yy * yy * yy)};
}

// Whether two ovals differ by more than what the dots' places, as they are found by contrast, are uncertain by. Where
// they do not, the last image's oval, from measured places, is the better one.
bool Tracker::differ(const Oval& one, const Oval& two) {
  const float most = oval_change * (two.xx + two.yy);
  return std::abs(one.xx - two.xx) > most || std::abs(one.xy - two.xy) > most || std::abs(one.yy - two.yy) > most;
}

Fit Tracker::fit(std::size_t marker, Point place, int passes) const {
  if (!(place.x > -setup_.radius && place.y > -setup_.radius && place.x < setup_.width + setup_.radius &&
        place.y < setup_.height + setup_.radius))
    return {place, 0, 0};
  return fit_dot(plane_, settings_, oval_[marker], inverse_[marker], setup_.contrast[marker], place, passes);
}

// The quality of a fit, 0 where it is cut by the image's border or its contrast is not that of the marker.
double Tracker::believed(std::size_t marker, const Fit& found) const {
  const double growth = found.contrast / setup_.contrast[marker];
  return is_inside(marker, found.place) && growth > weakest && growth < strongest ? found.quality : 0;
}

// Whether the dot of a marker at `place` is not cut by the image's border.
bool Tracker::is_inside(std::size_t marker, Point place) const {
  const Point half = half_[marker];
  return place.x > half.x && place.y > half.y && place.x < setup_.width - 1 - half.x &&
         place.y < setup_.height - 1 - half.y;
}

// Whether no marker next to `marker` was measured at this place.
bool Tracker::is_free(int marker, Point place) const {
  for (int way = 0; way < Grid::ways; ++way) {
    const int other = setup_.grid.neighbour(marker, way);
    if (other < 0 || !known_[std::size_t(other)]) continue;
    if (squared(places_[std::size_t(other)] - place) < 2 * setup_.radius * setup_.radius) return false;
  }
  return true;
}

// Gives up markers that are not where their neighbours say: the less of a dot's edge was seen, the closer it must be.
void Tracker::drop_strays() {
  for (std::size_t m = 0; m < steps_.size(); ++m) steps_[m] = places_[m] - setup_.rest[m];
  filled_ = known_;
  for (std::size_t m = 0; m < steps_.size(); ++m) {
    Point told;
    double discord;
    if (!filled_[m] || quality_[m] > unquestioned || !foretold(int(m), told, discord)) continue;
    const double most = stray * quality_[m] * quality_[m] * quality_[m] * setup_.spacing + discord;
    if (squared(steps_[m] - told) > most * most) known_[m] = 0, quality_[m] = 0;
  }
}

// The displacement of `marker` that the filled ones around it tell: the middle one of all that follow from two of them
// in a line with it, on either side or on the same. Right for any displacement that changes linearly; `discord` is how
// far the middle one of them is from that. False when there are fewer than three.
bool Tracker::foretold(int marker, Point& told, double& discord) const {
  std::array<double, 12> x, y;
  std::size_t n = 0;
  const auto filled = [&](int other) { return other >= 0 && filled_[std::size_t(other)]; };
  const auto step = [&](int other) { return steps_[std::size_t(other)]; };
  const auto tell = [&](Point p) { x[n] = p.x, y[n] = p.y, ++n; };
  for (int way = 0; way < Grid::ways; ++way) {
    const int near = setup_.grid.neighbour(marker, way), behind = setup_.grid.neighbour(marker, way, 2);
    const int opposite = setup_.grid.neighbour(marker, way, -1);
    if (!filled(near)) continue;
    if (way % 2 == 0 && filled(opposite)) tell(0.5 * (step(near) + step(opposite)));
    if (filled(behind)) tell(2 * step(near) - step(behind));
  }
  if (n < 3) return false;
  const auto middle = [n](std::array<double, 12>& values) {
    std::nth_element(values.begin(), values.begin() + n / 2, values.begin() + n);
    return values[n / 2];
  };
  told = {middle(x), middle(y)};
  for (std::size_t i = 0; i < n; ++i) x[i] = std::abs(x[i] - told.x), y[i] = std::abs(y[i] - told.y);
  discord = std::hypot(middle(x), middle(y));
  return true;
}

// The mean displacement of the filled markers around one, those next to it with twice the weight of those across; false
// when there are none.
bool Tracker::around(int marker, Point& mean) const {
  Point sum{};
  double weight = 0;
  for (int way = 0; way < Grid::ways; ++way) {
    const int other = setup_.grid.neighbour(marker, way);
    if (other < 0 || filled_[std::size_t(other)] != 1) continue;
    const double share = way < Grid::straight ? 2 : 1;
    sum = sum + share * steps_[std::size_t(other)];
    weight += share;
  }
  if (weight == 0) return false;
  mean = (1 / weight) * sum;
  return true;
}

// Places of markers that are not known, from the displacement of their neighbours: outwards from the known ones, then
// towards the mean of the neighbours.
void Tracker::spread() {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m) steps_[m] = places_[m] - setup_.rest[m];
  filled_ = known_;
  const auto pass = [&](bool outwards) {
    bool changed = false;
    for (std::size_t m = 0; m < n; ++m) {
      next_[m] = steps_[m];
      if (known_[m] || (outwards && filled_[m])) continue;
      if (!around(int(m), next_[m])) continue;
      if (!filled_[m]) filled_[m] = 2, changed = true;  // counts from the next pass on
    }
    steps_.swap(next_);
    for (char& f : filled_) f = char(f != 0);
    return changed;
  };
  while (pass(true)) {
  }
  for (int i = 0; i < relaxations; ++i) pass(false);
  for (std::size_t m = 0; m < n; ++m)
    if (!known_[m]) places_[m] = setup_.rest[m] + steps_[m];
}

}  // namespace gelflow::perception
