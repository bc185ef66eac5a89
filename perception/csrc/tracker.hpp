// The markers of one camera, from image to image: dots by contrast, whose they are, where exactly, and what is guessed.
#pragma once

#include "fit.hpp"
#include "follow.hpp"

namespace gelflow::perception {

// What the start has learned; all vectors have one entry per marker, row by row.
struct Setup {
  int width, height;
  Grid grid;
  Channel channel;
  bool bright;
  double spacing, radius;  // [px]
  double noise;            // of a pixel, as a share of the light
  Shape shape;
  std::vector<Point> rest;       // [px]
  std::vector<char> seen;        // whether there was a dot
  std::vector<Oval> oval;        // its shape
  std::vector<double> contrast;  // negative for dark dots
};

class Tracker {
 public:
  explicit Tracker(Setup setup);

  // Fits every marker of a first image where the setup says it is, and makes what it finds the rest. A marker whose
  // dot does not have the common shape counts as not seen from then on.
  void start(const std::uint8_t* bgr);
  // Follows the markers into the next image.
  void track(const std::uint8_t* bgr);

  const Setup& setup() const { return setup_; }
  int markers() const { return int(setup_.rest.size()); }
  // Of the newest image; where neither valid nor inferred, where the marker was last.
  const std::vector<Point>& places() const { return places_; }
  const std::vector<double>& quality() const { return quality_; }  // 0 where not valid
  const std::vector<double>& contrasts() const { return contrasts_; }
  bool anything_valid() const { return anything_valid_; }

 private:
  void measure(const std::vector<int>& owner);
  void accept(std::size_t marker, const Fit& found, double least);
  Oval stretched(std::size_t marker) const;
  static bool differ(const Oval& one, const Oval& two);
  Fit fit(std::size_t marker, Point place, int passes) const;
  double believed(std::size_t marker, const Fit& fit) const;
  bool is_inside(std::size_t marker, Point place) const;
  bool is_free(int marker, Point place) const;
  void drop_strays();
  bool foretold(int marker, Point& told, double& discord) const;
  bool around(int marker, Point& mean) const;
  void spread();
  void refine_rest();

  Setup setup_;
  FitSettings settings_;
  std::vector<Inverse> inverse_;
  std::vector<Oval> oval_;  // of the markers as the gel is stretched now
  Plane plane_;
  Contrast contrast_;
  Follow follow_;
  float least_ = 0.02f;  // response of a dot
  std::vector<Dot> dots_;
  std::vector<Point> half_;    // of a dot's width and height at rest
  std::vector<Point> offset_;  // from a dot as found by contrast to its centre, at rest
  std::vector<Point> places_, before_, velocity_, steps_, next_;
  std::vector<double> quality_, contrasts_;
  std::vector<char> known_, filled_, expected_;
  bool anything_valid_ = false;
  int at_rest_ = 0;  // images that the reference is the mean of; 0 when it is final
};

}  // namespace gelflow::perception
