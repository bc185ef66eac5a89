// Fuzz test of the tracker with random setups and images, for the sanitizers: `fuzz_tracker IMAGES [SEED]`. Stops at the
// first invalid memory access, undefined operation or invalid result.
#include <cstdio>
#include <cstdlib>
#include <optional>
#include <random>
#include <stdexcept>

#include "tracker.hpp"

using namespace gelflow::perception;

namespace {

std::mt19937_64 generator;

int whole(int low, int high) { return std::uniform_int_distribution<int>(low, high)(generator); }
double real(double low, double high) { return std::uniform_real_distribution<double>(low, high)(generator); }

TrackerSetup random_setup() {
  TrackerSetup setup{};
  setup.width = whole(1, 120), setup.height = whole(1, 90);
  setup.grid = {whole(3, 7), whole(3, 7)};
  setup.channel = Channel(whole(0, 5)), setup.bright = whole(0, 1) == 1;
  setup.radius = std::exp(real(std::log(0.6), std::log(15)));
  setup.spacing = setup.radius * real(2.01, 6);
  setup.noise = real(0, 0.2);
  setup.profile.reach = float(real(1.5, 6));
  for (std::size_t i = 0; i < setup.profile.value.size(); ++i)
    setup.profile.value[i] = float(1 / (1 + std::exp(0.1 * (double(i) - 60))) + (whole(0, 3) ? 0 : real(-0.2, 0.2)));
  const bool scattered = whole(0, 9) == 0;  // half of the grid far outside the image
  for (int m = 0; m < setup.grid.size(); ++m) {
    const double x = (m % setup.grid.cols + 0.5) * setup.spacing, y = (m / setup.grid.cols + 0.5) * setup.spacing;
    const bool far = scattered && whole(0, 1) == 1;
    setup.rest.push_back(far ? Point{real(-1e5, 1e5), real(-1e5, 1e5)} : Point{x + real(-2, 2), y + real(-2, 2)});
    setup.visible.push_back(char(whole(0, 9) > 0));
    const auto entry = [&](double low, double high) { return float(real(low, high) / setup.radius); };
    const auto wave = [] { return float(real(-0.2, 0.2)); };
    setup.shape.push_back(
        {entry(0.5, 2), entry(-0.4, 0.4), entry(-0.4, 0.4), entry(0.5, 2), {wave(), wave(), wave(), wave()}});
    setup.contrast.push_back((setup.bright ? 1 : -1) * real(0.01, 2)), setup.tolerated.push_back(real(0.05, 1));
    setup.mask_of.push_back(whole(0, 3) ? -1 : int(setup.masks.size()));
    if (setup.mask_of.back() < 0) continue;
    const int hidden = whole(0, DotMask::cells / 2);  // columns
    std::array<float, DotMask::cells * DotMask::cells>& weight = setup.masks.emplace_back().weight;
    for (std::size_t cell = 0; cell < weight.size(); ++cell)
      weight[cell] = int(cell % DotMask::cells) < hidden ? 0.0f : 1.0f;
  }
  return setup;
}

// Noise, a uniform colour, blocks, or a displaced grid of dots.
void random_image(const TrackerSetup& setup, std::vector<std::uint8_t>& image) {
  const int kind = whole(0, 5), level = whole(0, 255);
  const int other = whole(0, 1) ? whole(0, 255) : std::clamp(int(level * (1 + setup.contrast[0])), 0, 255);
  const double moved = setup.spacing * real(0, 1), dx = real(-1, 1) * moved, dy = real(-1, 1) * moved;
  for (int y = 0; y < setup.height; ++y)
    for (int x = 0; x < setup.width; ++x) {
      int value = level;
      if (kind == 0) value = whole(0, 255);
      if (kind == 1) value = ((x / 5 + y / 3) % 2) ? level : other;
      if (kind >= 3) {
        const double u = std::remainder(x - dx - 0.5 * setup.spacing, setup.spacing);
        const double v = std::remainder(y - dy - 0.5 * setup.spacing, setup.spacing);
        const bool inside = u * u + v * v < setup.radius * setup.radius;
        value = std::clamp((inside ? other : level) + whole(-kind, kind), 0, 255);
      }
      for (int c = 0; c < 3; ++c) image[std::size_t(3 * (y * setup.width + x) + c)] = std::uint8_t(value);
    }
}

void check(const Tracker& tracker) {
  for (int m = 0; m < tracker.markers(); ++m) {
    const std::size_t i = std::size_t(m);
    const Point position = tracker.positions()[i];
    const double quality = tracker.quality()[i];
    const bool sound = std::isfinite(position.x) && std::isfinite(position.y) && quality >= 0 && quality <= 1;
    const bool in_image =
        position.x > 0 && position.y > 0 && position.x < tracker.setup().width && position.y < tracker.setup().height;
    if (sound && (quality == 0 || in_image)) continue;
    std::fprintf(stderr, "marker %d at (%g, %g) with quality %g\n", m, position.x, position.y, quality);
    std::abort();
  }
}

}  // namespace

int main(int argc, char** argv) {
  const long images = argc > 1 ? std::strtol(argv[1], nullptr, 10) : 10000;
  generator.seed(argc > 2 ? std::strtoull(argv[2], nullptr, 10) : 1);
  std::vector<std::uint8_t> image;
  long done = 0, measured = 0, trackers = 0, refused = 0;
  while (done < images) {
    std::optional<Tracker> made;
    try {
      made.emplace(random_setup());
    } catch (const std::invalid_argument&) {  // no dot has an edge inside the image
      ++refused;
      continue;
    }
    Tracker& tracker = *made;
    image.resize(std::size_t(3 * tracker.setup().width * tracker.setup().height));
    ++trackers;
    for (int number = whole(1, 12); number > 0 && done < images; --number, ++done) {
      random_image(tracker.setup(), image);
      if (number % 6 == 1) {
        tracker.start(image.data());
      } else if (number % 6 == 2) {
        std::vector<Point> positions = tracker.positions();
        for (Point& position : positions) position = position + Point{real(-1, 1), real(-1, 1)};
        tracker.refine(image.data(), positions, std::vector<char>(positions.size(), char(whole(0, 1))));
      } else {
        tracker.track(image.data());
      }
      check(tracker);
      for (double quality : tracker.quality()) measured += quality > 0;
    }
  }
  std::printf("%ld images through %ld trackers (%ld setups refused), %ld markers measured, no errors\n", done, trackers,
              refused, measured);
  return refused > trackers;  // most setups were not tested
}
