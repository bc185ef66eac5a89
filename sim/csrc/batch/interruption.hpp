// Ends a long call early, for example at Ctrl-C: the calling thread asks from time to time, and all threads of the call
// see the answer before their next step.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <functional>

namespace gelflow {

class Interruption {
 public:
  static constexpr std::chrono::milliseconds period{50};  // between two questions

  // At the start of a call. `ask` returns whether to end it; empty: nothing ends it.
  void begin(std::function<bool()> ask) {
    ask_ = std::move(ask);
    requested_ = false;
  }
  bool requested() const { return requested_.load(std::memory_order_relaxed); }
  // Before a step or an item of thread `thread` of the call; thread 0 is the caller. Returns whether to end the call.
  bool check(int thread) {
    if (thread == 0 && --checks_left_ <= 0) read_clock();
    return requested();
  }
  // Of the caller: asks now.
  void ask() {
    asked_at_ = Clock::now();
    if (ask_ && ask_()) requested_ = true;
  }

 private:
  using Clock = std::chrono::steady_clock;

  // The clock is read about every millisecond: reading it may take longer than a short step.
  void read_clock() {
    constexpr int most_checks = 256;
    const Clock::time_point now = Clock::now();
    checks_ =
        now - read_at_ > std::chrono::milliseconds(1) ? std::max(1, checks_ / 2) : std::min(most_checks, checks_ * 2);
    checks_left_ = checks_;
    read_at_ = now;
    if (now - asked_at_ >= period) ask();
  }

  std::function<bool()> ask_;
  std::atomic<bool> requested_{false};
  int checks_ = 1, checks_left_ = 1;  // between two readings of the clock
  Clock::time_point read_at_{}, asked_at_{};
};

}  // namespace gelflow
