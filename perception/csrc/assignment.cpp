#include "assignment.hpp"

#include <cmath>

namespace gelflow::perception {

namespace {
// Distances are fractions of the spacing.
constexpr double seed_radius = 0.28;         // of a dot around a predicted position that starts a hypothesis
constexpr double match_radius = 0.3;         // of a dot around the position predicted by the neighbours
constexpr double max_difference = 0.45;      // of the displacements of neighbours
constexpr double inconsistency_cost = 0.75;  // of neighbours with a larger difference; 0.5 at this difference
constexpr double extrapolation = 0.7;        // damping of the linear extrapolation
constexpr double search_radius = 1.15;       // of the markers around a dot that the placement search tries
constexpr double motion_weight = 1.2;        // cost of moving by one spacing, in lines; an unassigned marker costs 1
constexpr double missing_line = 0.5;         // share of a line that must newly be unassigned for a search
constexpr int search_interval = 10;          // images between placement searches while a failure persists
}  // namespace

DotAssignment::DotAssignment(Grid grid, double spacing, double width, double height)
    : grid_(grid), spacing_(spacing), width_(width), height_(height) {
  const std::size_t n = std::size_t(grid.size());
  dot_of_.reserve(n), best_dot_of_.resize(n), last_.reserve(n), dropped_.reserve(n), heap_.reserve(16 * n);
}

// Counting sort of the dots into cells.
void DotAssignment::build_cells(const std::vector<Dot>& dots) {
  positions_.clear();
  for (const Dot& dot : dots) positions_.push_back(dot.position);
  Point high{-1e9, -1e9};
  cells_origin_ = {1e9, 1e9};
  for (Point p : positions_) {
    cells_origin_ = {std::min(cells_origin_.x, p.x), std::min(cells_origin_.y, p.y)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y)};
  }
  if (positions_.empty()) cells_origin_ = high = {};
  cells_x_ = int((high.x - cells_origin_.x) / spacing_) + 1, cells_y_ = int((high.y - cells_origin_.y) / spacing_) + 1;
  cell_begin_.assign(std::size_t(cells_x_) * std::size_t(cells_y_) + 1, 0);
  cell_of_.clear();
  for (Point p : positions_) {
    cell_of_.push_back(int((p.y - cells_origin_.y) / spacing_) * cells_x_ + int((p.x - cells_origin_.x) / spacing_));
    ++cell_begin_[std::size_t(cell_of_.back()) + 1];
  }
  for (std::size_t c = 1; c < cell_begin_.size(); ++c) cell_begin_[c] += cell_begin_[c - 1];
  cell_dots_.resize(positions_.size());
  for (std::size_t d = positions_.size(); d-- > 0;)  // backwards: turns the end of each cell into its start
    cell_dots_[std::size_t(--cell_begin_[std::size_t(cell_of_[d]) + 1])] = int(d);
  // Entry c + 1 now holds the start of cell c.
  for (std::size_t c = 0; c + 1 < cell_begin_.size(); ++c) cell_begin_[c] = cell_begin_[c + 1];
  cell_begin_.back() = int(positions_.size());
}

// The dot nearest to `position`, or −1 when none is closer than `within`, which is at most one spacing.
int DotAssignment::nearest_dot(Point position, double within, bool free_only) const {
  const double x = (position.x - cells_origin_.x) / spacing_, y = (position.y - cells_origin_.y) / spacing_;
  if (!(x > -1 && y > -1 && x < cells_x_ + 1 && y < cells_y_ + 1)) return -1;
  const int column = int(std::floor(x)), line = int(std::floor(y));
  int found = -1;
  double least = within * within;
  for (int v = std::max(line - 1, 0); v <= std::min(line + 1, cells_y_ - 1); ++v)
    for (int u = std::max(column - 1, 0); u <= std::min(column + 1, cells_x_ - 1); ++u) {
      const std::size_t cell = std::size_t(v * cells_x_ + u);
      for (int i = cell_begin_[cell]; i < cell_begin_[cell + 1]; ++i) {
        const int dot = cell_dots_[std::size_t(i)];
        const double distance = squared(positions_[std::size_t(dot)] - position);
        if (distance < least && !(free_only && is_taken_[std::size_t(dot)])) least = distance, found = dot;
      }
    }
  return found;
}

void DotAssignment::reset() {
  dot_of_.assign(last_.size(), -1);
  is_taken_.assign(positions_.size(), 0);
}

void DotAssignment::assign_dot(int marker, int dot) {
  dot_of_[std::size_t(marker)] = dot;
  is_taken_[std::size_t(dot)] = 1;
}

// Assigns the dots next to the predicted positions. The nearer of two markers gets a dot.
void DotAssignment::seed_nearest(const std::vector<Point>& predicted) {
  reset();
  heap_.clear();
  for (std::size_t m = 0; m < predicted.size(); ++m) {
    const int dot = nearest_dot(predicted[m], seed_radius * spacing_, false);
    if (dot >= 0) heap_.push_back({squared(positions_[std::size_t(dot)] - predicted[m]), int(m), dot});
  }
  std::make_heap(heap_.begin(), heap_.end());
  while (!heap_.empty()) {
    const Candidate candidate = heap_.front();
    std::pop_heap(heap_.begin(), heap_.end());
    heap_.pop_back();
    if (!is_taken_[std::size_t(candidate.dot)]) assign_dot(candidate.marker, candidate.dot);
  }
  drop_unsupported();
}

// Removes the assignments whose displacement agrees with fewer than two neighbours.
void DotAssignment::drop_unsupported() {
  dropped_.clear();
  for (int m = 0; m < grid_.size(); ++m) {
    if (dot_of_[std::size_t(m)] < 0) continue;
    const Point displacement = displacement_of(m);
    int shared = 0;
    for (int direction = 0; direction < Grid::directions; ++direction) {
      const int other = grid_.neighbour(m, direction);
      if (is_assigned(other))
        shared += squared(displacement_of(other) - displacement) < match_radius * match_radius * spacing_ * spacing_;
    }
    if (shared < 2) dropped_.push_back(m);
  }
  for (int m : dropped_) is_taken_[std::size_t(dot_of_[std::size_t(m)])] = 0, dot_of_[std::size_t(m)] = -1;
}

// Predicts the displacement of `marker` from its assigned neighbours: linear extrapolation where two lie in a line with
// it, else the displacement of the nearer one; axis neighbours have twice the weight of diagonal ones. False when no
// neighbour is assigned.
bool DotAssignment::predict_displacement(int marker, Point& displacement) const {
  Point sum{};
  double weight = 0;
  for (int direction = 0; direction < Grid::directions; ++direction) {
    const int near = grid_.neighbour(marker, direction), behind = grid_.neighbour(marker, direction, 2);
    if (!is_assigned(near)) continue;
    Point predicted = displacement_of(near);
    if (is_assigned(behind)) predicted = predicted + extrapolation * (predicted - displacement_of(behind));
    const double share = direction < Grid::axis_directions ? 2 : 1;
    sum = sum + share * predicted;
    weight += share;
  }
  if (weight == 0) return false;
  displacement = (1 / weight) * sum;
  return true;
}

void DotAssignment::push_candidate(int marker) {
  Point displacement;
  if (dot_of_[std::size_t(marker)] >= 0 || !predict_displacement(marker, displacement)) return;
  const Point position = last_[std::size_t(marker)] + displacement;
  const int dot = nearest_dot(position, match_radius * spacing_, true);
  if (dot < 0 || heap_.size() == heap_.capacity()) return;
  heap_.push_back({squared(positions_[std::size_t(dot)] - position), marker, dot});
  std::push_heap(heap_.begin(), heap_.end());
}

// Grows the hypothesis from the assigned markers, smallest prediction error first.
void DotAssignment::grow() {
  heap_.clear();
  for (int m = 0; m < grid_.size(); ++m) push_candidate(m);
  while (!heap_.empty()) {
    const Candidate candidate = heap_.front();
    std::pop_heap(heap_.begin(), heap_.end());
    heap_.pop_back();
    if (dot_of_[std::size_t(candidate.marker)] >= 0) continue;
    if (is_taken_[std::size_t(candidate.dot)]) {
      push_candidate(candidate.marker);
      continue;
    }
    assign_dot(candidate.marker, candidate.dot);
    for (int direction = 0; direction < Grid::directions; ++direction) {
      const int other = grid_.neighbour(candidate.marker, direction);
      if (other >= 0) push_candidate(other);
    }
  }
}

DotAssignment::Score DotAssignment::evaluate() const {
  Score score;
  const double unit = 1 / (spacing_ * spacing_);
  // Moving by a spacing along the rows costs more than a column without dots: covered dots do not look like a motion.
  const double motion_cost = motion_weight * unit / grid_.size();
  const double most = 2.0 * spacing_ * spacing_ * std::min(grid_.rows, grid_.cols);
  for (int m = 0; m < grid_.size(); ++m) {
    if (dot_of_[std::size_t(m)] < 0) {
      Point displacement{};
      predict_displacement(m, displacement);
      const Point p = last_[std::size_t(m)] + displacement;
      const bool inside = p.x > 0 && p.y > 0 && p.x < width_ - 1 && p.y < height_ - 1;
      score.markers += visible_[std::size_t(m)] && inside;
      continue;
    }
    const Point displacement = displacement_of(m);
    score.cost +=
        motion_cost *
        std::min(grid_.rows * displacement.x * displacement.x + grid_.cols * displacement.y * displacement.y, most);
    for (int direction : {Grid::rightward, Grid::downward}) {  // each pair once
      const int other = grid_.neighbour(m, direction);
      if (!is_assigned(other)) continue;
      const double apart = squared(displacement_of(other) - displacement) * unit;
      const double strain = apart / (max_difference * max_difference);
      score.cost += strain > 1 ? inconsistency_cost : 0.5 * strain;
      score.inconsistent += strain > 1;
    }
  }
  for (char taken : is_taken_) score.dots += !taken;
  score.cost += score.markers + score.dots;
  return score;
}

// Keeps the current hypothesis if it has the lowest cost. True when it explains the image as well as usual.
bool DotAssignment::keep_if_best() {
  const Score score = evaluate();
  if (score.cost < best_score_.cost) best_score_ = score, best_dot_of_ = dot_of_;
  return score.unexplained() <= last_score_.unexplained() + 1 && !misses_a_line(score);
}

// Whether many more markers or dots than in the last image are not assigned: after a jump by most of a spacing, the dots
// of an outer line may have left or entered the image, and the nearest dots are those of the neighbours.
bool DotAssignment::misses_a_line(const Score& score) const {
  const double many = missing_line * std::min(grid_.rows, grid_.cols);
  return score.markers > last_score_.markers + many || score.dots > last_score_.dots + many;
}

// Grows one hypothesis for each of a few dots and each marker around it; stops after two seeds without improvement.
void DotAssignment::search_placements() {
  Point low{1e9, 1e9}, high{-1e9, -1e9};
  for (Point p : last_) {
    low = {std::min(low.x, p.x), std::min(low.y, p.y)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y)};
  }
  const double seeds[5][2] = {{0.5, 0.5}, {0.25, 0.25}, {0.75, 0.75}, {0.75, 0.25}, {0.25, 0.75}};
  int failures = 0;
  for (const auto& seed : seeds) {
    if (failures == 2) return;
    const double before = best_score_.cost;
    const Point at = {low.x + seed[0] * (high.x - low.x), low.y + seed[1] * (high.y - low.y)};
    reset();
    const int dot = nearest_dot(at, spacing_, false);
    if (dot < 0) continue;
    for (int m = 0; m < grid_.size(); ++m) {
      if (squared(last_[std::size_t(m)] - positions_[std::size_t(dot)]) >
          search_radius * search_radius * spacing_ * spacing_)
        continue;
      reset();
      assign_dot(m, dot);
      grow();
      keep_if_best();
      if (best_score_.unexplained() == 0 && !misses_a_line(best_score_)) return;
    }
    failures = best_score_.cost < before ? 0 : failures + 1;
  }
}

// Removes the assignments whose displacement differs from the median of their neighbours.
void DotAssignment::drop_inconsistent() {
  dropped_.clear();
  for (int m = 0; m < grid_.size(); ++m) {
    if (dot_of_[std::size_t(m)] < 0) continue;
    std::array<double, 8> x, y;
    std::size_t n = 0;
    for (int direction = 0; direction < Grid::directions; ++direction) {
      const int other = grid_.neighbour(m, direction);
      if (!is_assigned(other)) continue;
      const Point displacement = displacement_of(other);
      x[n] = displacement.x, y[n] = displacement.y, ++n;
    }
    if (n < 3) continue;
    std::nth_element(x.begin(), x.begin() + n / 2, x.begin() + n);
    std::nth_element(y.begin(), y.begin() + n / 2, y.begin() + n);
    if (squared(displacement_of(m) - Point{x[n / 2], y[n / 2]}) > max_difference * max_difference * spacing_ * spacing_)
      dropped_.push_back(m);
  }
  for (int m : dropped_) dot_of_[std::size_t(m)] = -1;
}

const std::vector<int>& DotAssignment::assign(const std::vector<Dot>& dots, const std::vector<Point>& last,
                                              const std::vector<Point>& velocity, const std::vector<char>& visible) {
  build_cells(dots);
  last_ = last, visible_ = visible;
  best_score_ = {};
  best_score_.cost = 1e18;
  predicted_ = last;
  for (std::size_t m = 0; m < last.size(); ++m) predicted_[m] = last[m] + velocity[m];
  seed_nearest(predicted_);
  grow();
  bool done = keep_if_best();
  if (!done) {
    seed_nearest(last);
    grow();
    done = keep_if_best();
  }
  if (!done || ++images_since_search_ >= search_interval) {
    if (best_score_.unexplained() > 0 || misses_a_line(best_score_)) search_placements();
    images_since_search_ = 0;
  }
  if (2 * best_score_.markers < grid_.size()) last_score_ = best_score_;  // an image without most dots is no reference
  dot_of_ = best_dot_of_;
  drop_inconsistent();
  return dot_of_;
}

}  // namespace gelflow::perception
