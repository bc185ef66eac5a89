#include "follow.hpp"

#include <cmath>

namespace gelflow::perception {

namespace {
// As shares of the spacing.
constexpr double sure = 0.28;    // a dot so close to where a marker should be may begin a hypothesis
constexpr double met = 0.3;      // a dot so close to where the neighbours say is the marker's
constexpr double torn = 0.45;    // a step that differs so much from its neighbours' belongs to another dot
constexpr double carried = 0.7;  // share of a change from one marker to the next that goes on to the one after
constexpr double around = 1.15;  // markers at most so far from a dot are tried for it
constexpr double motion = 0.1;   // what moving by a spacing costs, against 1 for a marker or dot left over
constexpr int retry = 10;        // images after which a lasting failure is looked at again
}  // namespace

Follow::Follow(Grid grid, double spacing) : grid_(grid), spacing_(spacing) {
  const std::size_t n = std::size_t(grid.size());
  owner_.reserve(n), best_.resize(n), last_.reserve(n), order_.reserve(n), heap_.reserve(16 * n);
}

// Sorts the dots into cells, by counting.
void Follow::sort_dots(const std::vector<Dot>& dots) {
  places_.clear();
  for (const Dot& dot : dots) places_.push_back(dot.place);
  Point high{-1e9, -1e9};
  low_ = {1e9, 1e9};
  for (Point p : places_) {
    low_ = {std::min(low_.x, p.x), std::min(low_.y, p.y)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y)};
  }
  if (places_.empty()) low_ = high = {};
  cells_x_ = int((high.x - low_.x) / spacing_) + 1, cells_y_ = int((high.y - low_.y) / spacing_) + 1;
  cell_begin_.assign(std::size_t(cells_x_) * std::size_t(cells_y_) + 1, 0);
  cell_of_.clear();
  for (Point p : places_) {
    cell_of_.push_back(int((p.y - low_.y) / spacing_) * cells_x_ + int((p.x - low_.x) / spacing_));
    ++cell_begin_[std::size_t(cell_of_.back()) + 1];
  }
  for (std::size_t c = 1; c < cell_begin_.size(); ++c) cell_begin_[c] += cell_begin_[c - 1];
  cell_dots_.resize(places_.size());
  for (std::size_t d = places_.size(); d-- > 0;)  // backwards: a cell's end moves down to its begin
    cell_dots_[std::size_t(--cell_begin_[std::size_t(cell_of_[d]) + 1])] = int(d);
  // Each entry now holds the begin of the cell before it: shift back.
  for (std::size_t c = 0; c + 1 < cell_begin_.size(); ++c) cell_begin_[c] = cell_begin_[c + 1];
  cell_begin_.back() = int(places_.size());
}

// The dot nearest to `place` within a distance of at most one spacing, or −1.
int Follow::nearest(Point place, double within, bool free_only) const {
  const double x = (place.x - low_.x) / spacing_, y = (place.y - low_.y) / spacing_;
  if (!(x > -1 && y > -1 && x < cells_x_ + 1 && y < cells_y_ + 1)) return -1;
  const int column = int(std::floor(x)), line = int(std::floor(y));
  int found = -1;
  double least = within * within;
  for (int v = std::max(line - 1, 0); v <= std::min(line + 1, cells_y_ - 1); ++v)
    for (int u = std::max(column - 1, 0); u <= std::min(column + 1, cells_x_ - 1); ++u) {
      const std::size_t cell = std::size_t(v * cells_x_ + u);
      for (int i = cell_begin_[cell]; i < cell_begin_[cell + 1]; ++i) {
        const int dot = cell_dots_[std::size_t(i)];
        const double distance = squared(places_[std::size_t(dot)] - place);
        if (distance < least && !(free_only && taken_[std::size_t(dot)])) least = distance, found = dot;
      }
    }
  return found;
}

void Follow::clear() {
  owner_.assign(last_.size(), -1);
  taken_.assign(places_.size(), 0);
}

void Follow::take(int marker, int dot) {
  owner_[std::size_t(marker)] = dot;
  taken_[std::size_t(dot)] = 1;
}

// Begins with the dots next to where the markers are predicted; of two markers at one dot the nearer one gets it.
void Follow::seed_nearest(const std::vector<Point>& predicted) {
  clear();
  heap_.clear();
  for (std::size_t m = 0; m < predicted.size(); ++m) {
    const int dot = nearest(predicted[m], sure * spacing_, false);
    if (dot >= 0) heap_.push_back({squared(places_[std::size_t(dot)] - predicted[m]), int(m), dot});
  }
  std::make_heap(heap_.begin(), heap_.end());
  while (!heap_.empty()) {
    const Claim claim = heap_.front();
    std::pop_heap(heap_.begin(), heap_.end());
    heap_.pop_back();
    if (!taken_[std::size_t(claim.dot)]) take(claim.marker, claim.dot);
  }
  prune();
}

// Gives up markers whose step fewer than two neighbours share.
void Follow::prune() {
  order_.clear();
  for (int m = 0; m < grid_.size(); ++m) {
    if (owner_[std::size_t(m)] < 0) continue;
    const Point own = step_of(m);
    int shared = 0;
    for (int way = 0; way < Grid::ways; ++way) {
      const int other = grid_.neighbour(m, way);
      if (owned(other)) shared += squared(step_of(other) - own) < met * met * spacing_ * spacing_;
    }
    if (shared < 2) order_.push_back(m);
  }
  for (int m : order_) taken_[std::size_t(owner_[std::size_t(m)])] = 0, owner_[std::size_t(m)] = -1;
}

// The step of `marker` by its known neighbours: where two lie in a line with it, their change is carried on, else the
// nearer one's step; next to it twice the weight of across. False when there is none.
bool Follow::expectation(int marker, Point& step) const {
  Point sum{};
  double weight = 0;
  for (int way = 0; way < Grid::ways; ++way) {
    const int near = grid_.neighbour(marker, way), behind = grid_.neighbour(marker, way, 2);
    if (!owned(near)) continue;
    Point told = step_of(near);
    if (owned(behind)) told = told + carried * (told - step_of(behind));
    const double share = way < Grid::straight ? 2 : 1;
    sum = sum + share * told;
    weight += share;
  }
  if (weight == 0) return false;
  step = (1 / weight) * sum;
  return true;
}

void Follow::offer(int marker) {
  Point step;
  if (owner_[std::size_t(marker)] >= 0 || !expectation(marker, step)) return;
  const Point place = last_[std::size_t(marker)] + step;
  const int dot = nearest(place, met * spacing_, true);
  if (dot < 0 || heap_.size() == heap_.capacity()) return;
  heap_.push_back({squared(places_[std::size_t(dot)] - place), marker, dot});
  std::push_heap(heap_.begin(), heap_.end());
}

// Grows from the markers that are known, the best met expectation first.
void Follow::grow() {
  heap_.clear();
  for (int m = 0; m < grid_.size(); ++m) offer(m);
  while (!heap_.empty()) {
    const Claim claim = heap_.front();
    std::pop_heap(heap_.begin(), heap_.end());
    heap_.pop_back();
    if (owner_[std::size_t(claim.marker)] >= 0) continue;
    if (taken_[std::size_t(claim.dot)]) {
      offer(claim.marker);
      continue;
    }
    take(claim.marker, claim.dot);
    for (int way = 0; way < Grid::ways; ++way) {
      const int other = grid_.neighbour(claim.marker, way);
      if (other >= 0) offer(other);
    }
  }
}

Follow::Left Follow::judge(const std::vector<char>& expected) const {
  Left left;
  const double unit = 1 / (spacing_ * spacing_);
  for (int m = 0; m < grid_.size(); ++m) {
    if (owner_[std::size_t(m)] < 0) {
      left.markers += expected[std::size_t(m)];
      continue;
    }
    const Point own = step_of(m);
    left.cost += motion * std::min(squared(own) * unit, 2.0);
    for (int way : {Grid::to_the_right, Grid::downwards}) {  // every pair once
      const int other = grid_.neighbour(m, way);
      if (!owned(other)) continue;
      const double apart = squared(step_of(other) - own) * unit;
      left.cost += 0.5 * std::min(apart / (torn * torn), 1.0);
      left.torn += apart > torn * torn;
    }
  }
  for (char taken : taken_) left.dots += !taken;
  left.cost += left.markers + left.dots;
  return left;
}

// Keeps the present hypothesis when it leaves less over than the best one; whether it leaves no more than usual.
bool Follow::consider(const std::vector<char>& expected) {
  const Left left = judge(expected);
  if (left.cost < best_left_.cost) best_left_ = left, best_ = owner_;
  return left.unexplained() <= usual_ + 1;
}

void Follow::try_placements(const std::vector<char>& expected) {
  Point low{1e9, 1e9}, high{-1e9, -1e9};
  for (Point p : last_) {
    low = {std::min(low.x, p.x), std::min(low.y, p.y)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y)};
  }
  const double seeds[5][2] = {{0.5, 0.5}, {0.25, 0.25}, {0.75, 0.75}, {0.75, 0.25}, {0.25, 0.75}};
  int in_vain = 0;
  for (const auto& seed : seeds) {
    if (in_vain == 2) return;
    const double before = best_left_.cost;
    const Point at = {low.x + seed[0] * (high.x - low.x), low.y + seed[1] * (high.y - low.y)};
    clear();
    const int dot = nearest(at, spacing_, false);
    if (dot < 0) continue;
    for (int m = 0; m < grid_.size(); ++m) {
      if (squared(last_[std::size_t(m)] - places_[std::size_t(dot)]) > around * around * spacing_ * spacing_) continue;
      clear();
      take(m, dot);
      grow();
      consider(expected);
      if (best_left_.unexplained() == 0) return;
    }
    in_vain = best_left_.cost < before ? 0 : in_vain + 1;
  }
}

// Gives up markers that went elsewhere than the middle one of their neighbours.
void Follow::drop_torn() {
  order_.clear();
  for (int m = 0; m < grid_.size(); ++m) {
    if (owner_[std::size_t(m)] < 0) continue;
    std::array<double, 8> x, y;
    std::size_t n = 0;
    for (int way = 0; way < Grid::ways; ++way) {
      const int other = grid_.neighbour(m, way);
      if (!owned(other)) continue;
      const Point step = step_of(other);
      x[n] = step.x, y[n] = step.y, ++n;
    }
    if (n < 3) continue;
    std::nth_element(x.begin(), x.begin() + n / 2, x.begin() + n);
    std::nth_element(y.begin(), y.begin() + n / 2, y.begin() + n);
    if (squared(step_of(m) - Point{x[n / 2], y[n / 2]}) > torn * torn * spacing_ * spacing_) order_.push_back(m);
  }
  for (int m : order_) owner_[std::size_t(m)] = -1;
}

const std::vector<int>& Follow::assign(const std::vector<Dot>& dots, const std::vector<Point>& last,
                                       const std::vector<Point>& velocity, const std::vector<char>& expected) {
  sort_dots(dots);
  last_ = last;
  best_left_ = {};
  best_left_.cost = 1e18;
  predicted_ = last;
  for (std::size_t m = 0; m < last.size(); ++m) predicted_[m] = last[m] + velocity[m];
  seed_nearest(predicted_);
  grow();
  bool done = consider(expected);
  if (!done) {
    seed_nearest(last);
    grow();
    done = consider(expected);
  }
  if (!done || ++images_ >= retry) {
    if (best_left_.unexplained() > 0) try_placements(expected);
    images_ = 0;
  }
  usual_ = best_left_.unexplained();
  owner_ = best_;
  drop_torn();
  return owner_;
}

}  // namespace gelflow::perception
