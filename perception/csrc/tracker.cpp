#include "tracker.hpp"

#include <stdexcept>

namespace gelflow::perception {

namespace {
constexpr double least_quality = 0.4;       // of a fit that is believed
constexpr double least_quality_lost = 0.6;  // the same where no dot stood out, only the neighbours say where to look
constexpr double weakest = 0.35, strongest = 2.2;  // contrast that is believed, against that at rest
constexpr double faintest = 0.3;                   // response of a dot, against the middle one at rest
constexpr double fastest = 0.25;  // of the spacing per image: more is taken for a jump, not for a velocity
constexpr int relaxations = 8;

const int neighbour_row[8] = {0, 0, 1, -1, 1, 1, -1, -1};
const int neighbour_col[8] = {1, -1, 0, 0, 1, -1, 1, -1};

// As wide as makes the light's slope certain, but without the neighbours' dots.
int window_size(double radius, double spacing) {
  const int wanted = int(std::ceil(3.8 * radius / lanes)) * lanes, most = int(0.85 * spacing / lanes) * lanes;
  return std::clamp(wanted, lanes, std::clamp(most, lanes, Plane::margin / 2));
}
}  // namespace

Tracker::Tracker(Setup setup)
    : setup_(std::move(setup)),
      settings_{setup_.shape, window_size(setup_.radius, setup_.spacing), setup_.radius, setup_.noise},
      inverse_(setup_.rest.size()),
      plane_(setup_.width, setup_.height),
      contrast_(setup_.width, setup_.height, setup_.radius, setup_.spacing, setup_.bright),
      follow_(setup_.rows, setup_.cols, setup_.spacing) {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m)
    if (!normal_inverse(setup_.shape, setup_.oval[m], setup_.contrast[m], settings_.window, inverse_[m]))
      throw std::invalid_argument("the shape of a dot does not tell where its centre is");
  places_ = before_ = setup_.rest;
  velocity_.resize(n), steps_.resize(n), next_.resize(n);
  quality_.resize(n), contrasts_.resize(n);
  known_.resize(n), filled_.resize(n), expected_.resize(n);
  dots_.reserve(2 * n + 64);
}

void Tracker::start(const std::uint8_t* bgr) {
  take_plane(bgr, plane_, setup_.channel);
  anything_valid_ = false;
  for (std::size_t m = 0; m < setup_.rest.size(); ++m) {
    quality_[m] = 0;
    if (!setup_.seen[m]) continue;
    const Fit found = fit(m, setup_.rest[m], 12);
    quality_[m] = found.quality, contrasts_[m] = found.contrast;
    if (found.quality < least_quality) {
      setup_.seen[m] = 0, quality_[m] = 0;
      continue;
    }
    setup_.rest[m] = found.place, setup_.contrast[m] = found.contrast;
    anything_valid_ = true;
  }
  places_ = setup_.rest;
  std::fill(velocity_.begin(), velocity_.end(), Point{});
  contrast_.find(plane_, 0.0f, 4 * setup_.rest.size() + 64, dots_);
  std::vector<float> strength;
  for (const Dot& dot : dots_)
    for (std::size_t m = 0; m < setup_.rest.size(); ++m)
      if (setup_.seen[m] && squared(dot.place - setup_.rest[m]) < setup_.radius * setup_.radius)
        strength.push_back(dot.response);
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
    expected_[m] = char(setup_.seen[m] && is_inside(before_[m] + velocity_[m]));
  measure(follow_.assign(dots_, before_, velocity_, expected_));
  anything_valid_ = std::any_of(known_.begin(), known_.end(), [](char k) { return k != 0; });
  const double most = fastest * setup_.spacing;
  for (std::size_t m = 0; m < places_.size(); ++m) {
    const Point v = places_[m] - before_[m];
    const double length = std::sqrt(squared(v));
    velocity_[m] = length <= most ? v : Point{};
  }
}

// Fits the dots that markers own, then looks for the others where their neighbours say; guesses what is left.
void Tracker::measure(const std::vector<int>& owner) {
  const std::size_t n = setup_.rest.size();
  for (std::size_t m = 0; m < n; ++m) {
    known_[m] = 0, quality_[m] = 0;
    if (owner[m] < 0 || !setup_.seen[m]) continue;
    const Fit found = fit(m, dots_[std::size_t(owner[m])].place, 8);
    quality_[m] = believed(m, found);
    known_[m] = quality_[m] >= least_quality;
    if (known_[m]) places_[m] = found.place;
  }
  if (std::none_of(known_.begin(), known_.end(), [](char k) { return k != 0; })) {
    std::fill(quality_.begin(), quality_.end(), 0.0);
    return;
  }
  spread();
  for (std::size_t m = 0; m < n; ++m) {
    if (known_[m]) continue;
    quality_[m] = 0;
    if (!setup_.seen[m]) continue;
    const Fit found = fit(m, places_[m], 8);
    const double quality = believed(m, found);
    if (quality >= least_quality_lost && is_free(int(m), found.place)) {
      places_[m] = found.place, quality_[m] = quality, known_[m] = 1;
    }
  }
  spread();
}

Fit Tracker::fit(std::size_t marker, Point place, int passes) const {
  if (!(place.x > -setup_.radius && place.y > -setup_.radius && place.x < setup_.width + setup_.radius &&
        place.y < setup_.height + setup_.radius))
    return {place, 0, 0};
  return fit_dot(plane_, settings_, setup_.oval[marker], inverse_[marker], setup_.contrast[marker], place, passes);
}

// The quality of a fit, 0 where it is cut by the image's border or its contrast is not that of the marker.
double Tracker::believed(std::size_t marker, const Fit& found) const {
  const double growth = found.contrast / setup_.contrast[marker];
  return is_inside(found.place) && growth > weakest && growth < strongest ? found.quality : 0;
}

bool Tracker::is_inside(Point place) const {
  const double border = 0.9 * setup_.radius;
  return place.x > border && place.y > border && place.x < setup_.width - 1 - border &&
         place.y < setup_.height - 1 - border;
}

// Whether no marker next to `marker` was measured at this place.
bool Tracker::is_free(int marker, Point place) const {
  const int row = marker / setup_.cols, col = marker % setup_.cols;
  for (int k = 0; k < 8; ++k) {
    const int r = row + neighbour_row[k], c = col + neighbour_col[k];
    if (r < 0 || r >= setup_.rows || c < 0 || c >= setup_.cols) continue;
    const std::size_t other = std::size_t(r * setup_.cols + c);
    if (known_[other] && squared(places_[other] - place) < 2 * setup_.radius * setup_.radius) return false;
  }
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
      Point sum{};
      double weight = 0;
      const int row = int(m) / setup_.cols, col = int(m) % setup_.cols;
      for (int k = 0; k < 8; ++k) {
        const int r = row + neighbour_row[k], c = col + neighbour_col[k];
        if (r < 0 || r >= setup_.rows || c < 0 || c >= setup_.cols) continue;
        const std::size_t other = std::size_t(r * setup_.cols + c);
        if (filled_[other] != 1) continue;
        const double share = k < 4 ? 2 : 1;
        sum = sum + share * steps_[other];
        weight += share;
      }
      if (weight == 0) continue;
      next_[m] = (1 / weight) * sum;
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
