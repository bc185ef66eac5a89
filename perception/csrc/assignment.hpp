// Assigns detected dots to markers, by the topology of the grid and the predicted motion.
//
// A hypothesis starts from a few dots that are assigned to markers and grows over the grid: the displacement of a marker
// since the last image is predicted from its assigned neighbours (extrapolated linearly where two lie in a line with
// it), and the candidate with the smallest prediction error is assigned first. The cost of a hypothesis counts markers
// without a dot inside the image, dots without a marker, inconsistent displacements of neighbours and, with a small
// weight, the mean motion.
//
// The first hypotheses start from the dots nearest to the predicted and to the last marker positions. They fail where
// markers jump by more than half their spacing; the only sign may be an outer line of markers or dots that is not
// assigned. Then a search assigns each of a few dots, spread over the image, to each of the markers around it in turn,
// grows the whole grid from that pair, and keeps the hypothesis with the lowest cost.
// The order of operations is fixed; nothing is random.
#pragma once

#include <array>

#include "dot_detector.hpp"
#include "grid.hpp"

namespace gelflow::perception {

class DotAssignment {
 public:
  // `width` and `height` are those of the image [px].
  DotAssignment(Grid grid, double spacing, double width, double height);

  // The index in `dots` of each marker's dot, or −1. Per marker: `last` is the last position, `velocity` the
  // displacement per image, `visible` whether its dot can be seen inside the image.
  const std::vector<int>& assign(const std::vector<Dot>& dots, const std::vector<Point>& last,
                                 const std::vector<Point>& velocity, const std::vector<char>& visible);

 private:
  struct Candidate {  // a dot near the predicted position of a marker
    double distance;
    int marker, dot;
    bool operator<(const Candidate& o) const {  // a heap has the nearest candidate on top
      return distance != o.distance ? distance > o.distance : (marker != o.marker ? marker > o.marker : dot > o.dot);
    }
  };
  struct Score {                // of a hypothesis
    int markers = 0, dots = 0;  // markers with their centre in the image, and dots, that are not assigned
    int inconsistent = 0;       // pairs of neighbours with different displacements
    double cost = 0;
    // Signs of a wrong hypothesis; bridges and dust cause a few. Covered markers alone are none.
    int unexplained() const { return std::min(markers, dots) + inconsistent; }
  };

  void build_cells(const std::vector<Dot>& dots);
  int nearest_dot(Point position, double within, bool free_only) const;
  void reset();
  void assign_dot(int marker, int dot);
  void seed_nearest(const std::vector<Point>& predicted);
  void drop_unsupported();
  bool predict_displacement(int marker, Point& displacement) const;
  void push_candidate(int marker);
  void grow();
  Score evaluate() const;
  bool keep_if_best();
  bool misses_a_line(const Score& score) const;
  void search_placements();
  void drop_inconsistent();

  bool is_assigned(int marker) const { return marker >= 0 && dot_of_[std::size_t(marker)] >= 0; }
  Point displacement_of(int marker) const {  // since the last image
    return positions_[std::size_t(dot_of_[std::size_t(marker)])] - last_[std::size_t(marker)];
  }

  Grid grid_;
  double spacing_, width_, height_;
  std::vector<Point> positions_, last_, predicted_;
  std::vector<int> dot_of_, best_dot_of_, dropped_;
  std::vector<char> is_taken_, visible_;
  std::vector<Candidate> heap_;
  Score best_score_;
  Score last_score_;             // of the last image that showed most of the grid
  int images_since_search_ = 0;  // since the last search over placements
  // Dots sorted into square cells of one spacing: cell_dots_[cell_begin_[c]] … cell_dots_[cell_begin_[c + 1] − 1].
  int cells_x_ = 0, cells_y_ = 0;
  Point cells_origin_;
  std::vector<int> cell_begin_, cell_dots_, cell_of_;
};

}  // namespace gelflow::perception
