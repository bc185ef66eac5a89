// Which dot is which marker: by the grid's topology and by where the markers were going.
//
// A hypothesis begins with dots that are taken for certain markers, and grows from these over the grid: each marker
// next to a known one is expected where it was, plus how far its known neighbours went (and how that changes from one
// to the next); the marker whose expectation a dot meets best comes first. What a hypothesis leaves over judges it:
// markers without a dot, dots without a marker, neighbours that are torn apart, and, as the smallest part, how far
// everything went.
//
// The first hypotheses begin with the dots nearest to where the markers should be by now, and to where they were.
// They fail where markers jumped by more than half their spacing: then each of a few dots, spread over the image, is
// taken for each of the markers around it in turn, the whole grid is grown from that one pair, and the one grid that
// leaves least over wins. The order of work is fixed; nothing is random.
#pragma once

#include <array>

#include "contrast.hpp"
#include "grid.hpp"

namespace gelflow::perception {

class Follow {
 public:
  Follow(Grid grid, double spacing);

  // For each marker the number of its dot in `dots`, or −1. `last` is where the markers were, `velocity` by how much
  // they moved in the last image, `expected` which of them should be seen; one entry per marker.
  const std::vector<int>& assign(const std::vector<Dot>& dots, const std::vector<Point>& last,
                                 const std::vector<Point>& velocity, const std::vector<char>& expected);

 private:
  struct Claim {  // a dot that lies where a marker is expected
    double distance;
    int marker, dot;
    bool operator<(const Claim& o) const {  // the top of a heap is the nearest one
      return distance != o.distance ? distance > o.distance : (marker != o.marker ? marker > o.marker : dot > o.dot);
    }
  };
  struct Left {  // what a hypothesis leaves over
    int markers = 0, dots = 0, torn = 0;
    double cost = 0;
    int unexplained() const { return std::min(markers, dots) + torn; }
  };

  void sort_dots(const std::vector<Dot>& dots);
  int nearest(Point place, double within, bool free_only) const;
  void clear();
  void take(int marker, int dot);
  void seed_nearest(const std::vector<Point>& predicted);
  void prune();
  bool expectation(int marker, Point& step) const;
  void offer(int marker);
  void grow();
  Left judge(const std::vector<char>& expected) const;
  bool consider(const std::vector<char>& expected);
  void try_placements(const std::vector<char>& expected);
  void drop_torn();

  bool owned(int marker) const { return marker >= 0 && owner_[std::size_t(marker)] >= 0; }
  Point step_of(int marker) const {
    return places_[std::size_t(owner_[std::size_t(marker)])] - last_[std::size_t(marker)];
  }

  Grid grid_;
  double spacing_;
  std::vector<Point> places_, last_, predicted_;
  std::vector<int> owner_, best_, order_;
  std::vector<char> taken_;
  std::vector<Claim> heap_;
  Left best_left_;
  int usual_ = 0;   // what is left unexplained in each image, by bridges and dust
  int images_ = 0;  // since every hypothesis was tried
  // Dots by cells as wide as the spacing: cell_begin_[c] … cell_begin_[c + 1] in cell_dots_.
  int cells_x_ = 0, cells_y_ = 0;
  Point low_;
  std::vector<int> cell_begin_, cell_dots_, cell_of_;
};

}  // namespace gelflow::perception
