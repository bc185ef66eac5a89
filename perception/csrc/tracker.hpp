// Tracks the markers of one camera: detects dots, assigns them to markers, fits their centres, infers missing markers.
#pragma once

#include "assignment.hpp"
#include "dot_fit.hpp"
#include "edge_fit.hpp"

namespace gelflow::perception {

// The dot model of the first image. Vectors have one entry per marker, row by row.
struct TrackerSetup {
  int width, height;
  Grid grid;
  Channel channel;
  bool bright;
  double spacing, radius;  // [px]
  double noise;            // standard deviation of a pixel / background
  DotProfile profile;
  std::vector<Point> rest;        // position at rest [px]
  std::vector<char> visible;      // whether the first image shows its dot
  std::vector<DotShape> shape;    // of its dot
  std::vector<double> contrast;   // of its dot, negative for dark dots
  std::vector<double> tolerated;  // residual / contrast at which a pixel of its dot has half the weight
  std::vector<int> mask_of;       // index of the mask of its dot; -1 for a dot that its shape describes entirely
  std::vector<DotMask> masks;
};

constexpr double largest_refinement = 0.1;  // of a position that another tracker found [radii]

class Tracker {
 public:
  explicit Tracker(TrackerSetup setup);

  // Fits the dot of each visible marker near its rest position; the fits become the rest positions and contrasts. A
  // marker whose dot does not match the profile is not visible from then on.
  void start(const std::uint8_t* bgr);
  // Tracks the markers in the next image.
  void track(const std::uint8_t* bgr);
  // Fits the `wanted` markers of the next image near `positions`, which another tracker found. The others, and those
  // whose fit is poor or ends elsewhere, get the quality 0.
  void refine(const std::uint8_t* bgr, const std::vector<Point>& positions, const std::vector<char>& wanted);

  const TrackerSetup& setup() const { return setup_; }
  int markers() const { return int(setup_.rest.size()); }
  // In the latest image; the last position of markers that are neither valid nor inferred [px].
  const std::vector<Point>& positions() const { return positions_; }
  const std::vector<double>& quality() const { return quality_; }  // 0 for markers that are not valid
  const std::vector<double>& contrasts() const { return contrasts_; }
  bool anything_valid() const { return anything_valid_; }

 private:
  void measure(const std::vector<int>& dot_of);
  void refit_deformed();
  void accept(std::size_t marker, const DotFit& found, double threshold);
  DotShape deformed_shape(std::size_t marker) const;
  void correct_curvature();
  Point outline_offset(std::size_t marker) const;
  static bool differ(const DotShape& one, const DotShape& two, float change);
  const DotMask* mask(std::size_t marker) const;
  DotFit fit(std::size_t marker, const FitStart& start) const;
  double accepted_quality(std::size_t marker, const DotFit& fit) const;
  bool is_inside(std::size_t marker, Point position) const;
  bool is_unoccupied(int marker, Point position) const;
  bool reject_outliers();
  bool extrapolate(int marker, Point& predicted, double& deviation) const;
  bool neighbour_mean(int marker, Point& mean) const;
  void fill_missing();
  void refine_rest();
  bool is_incoherent() const;

  TrackerSetup setup_;
  FitSettings settings_;
  std::vector<FitBasis> fit_basis_;
  EdgeFit edge_fit_;
  std::vector<double> rest_quality_;  // of the fits at rest
  std::vector<DotShape> shape_;       // of the dots on the deformed gel
  std::vector<DotShape> next_shape_;  // from the fitted positions
  Plane plane_;
  DotDetector detector_;
  DotAssignment assignment_;
  float threshold_ = 0.02f;  // minimum response of a dot
  std::vector<Dot> dots_;
  std::vector<Point> half_size_;  // half width and half height of a dot at rest, reduced by its blurred edge [px]
  std::vector<Point> detection_offset_;  // from a detected dot to its fitted centre, at rest [px]
  std::vector<Point> positions_, previous_, velocity_, displacement_, relaxed_;
  std::vector<double> quality_, contrasts_;
  std::vector<char> measured_, filled_;
  bool anything_valid_ = false;
  int rest_images_ = 0;  // images averaged in the rest positions; 0 when these are final
};

}  // namespace gelflow::perception
