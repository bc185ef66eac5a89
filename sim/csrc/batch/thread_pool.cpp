#include <algorithm>
#include <chrono>

#ifdef __linux__
#include <pthread.h>
#include <sched.h>
#endif

#include "batch/batch.hpp"

namespace gelflow {

namespace {

using Clock = std::chrono::steady_clock;

// How long to look out before one sleeps: to be woken takes some 100 µs, much more on a virtual machine. Who worked for
// longer may look out for longer, for a share of that time.
constexpr std::chrono::microseconds least_patience(100), most_patience(500);
constexpr int share = 2;

Clock::duration patience_after(Clock::time_point begun) {
  return std::clamp<Clock::duration>((Clock::now() - begun) / share, least_patience, most_patience);
}

// Looks out for that long. Whether it came true.
template <class Condition>
bool soon(const Condition& condition, Clock::duration patience) {
  constexpr int looks = 64;
  const Clock::time_point end = Clock::now() + patience;
  do {
    for (int i = 0; i < looks; ++i) {
      if (condition()) return true;
#ifdef __x86_64__
      __builtin_ia32_pause();
#endif
    }
  } while (Clock::now() < end);
  return false;
}

int core_here() {
#ifdef __linux__
  return sched_getcpu();
#else
  return -1;
#endif
}

}  // namespace

// A helper that waits on the core where the caller runs, or wakes up there, gets it only now and then, and Linux may leave
// it there for milliseconds while another core is idle. So it is told to go elsewhere, until it is at work.
struct ThreadPool::Helper {
  std::thread thread;
  static constexpr int asleep = -2;
  std::atomic<int> core{asleep};  // where it was when it began to look out

#ifdef __linux__
  void make_way(int caller) {
    if (core != caller && core != asleep) return;
    if (sched_getaffinity(0, sizeof allowed_, &allowed_) != 0) return;
    cpu_set_t elsewhere = allowed_;
    CPU_CLR(caller, &elsewhere);
    if (CPU_COUNT(&elsewhere) == 0) return;
    sent_away_ = pthread_setaffinity_np(thread.native_handle(), sizeof elsewhere, &elsewhere) == 0;
  }
  void settle() {
    if (sent_away_.exchange(false)) pthread_setaffinity_np(pthread_self(), sizeof allowed_, &allowed_);
  }

 private:
  cpu_set_t allowed_;  // of the caller
  std::atomic<bool> sent_away_{false};
#else
  void make_way(int) {}
  void settle() {}
#endif
};

ThreadPool::ThreadPool(int threads) {
  for (int i = 1; i < threads; ++i) {
    Helper& helper = *helpers_.emplace_back(std::make_unique<Helper>());
    helper.thread = std::thread([this, &helper, i] { loop(helper, i); });
  }
}

ThreadPool::~ThreadPool() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  start_.notify_all();
  for (const auto& helper : helpers_) helper->thread.join();
}

int ThreadPool::size() const { return static_cast<int>(helpers_.size()) + 1; }

void ThreadPool::take(int thread) {
  for (int item = next_.fetch_add(1); item < items_; item = next_.fetch_add(1)) (*work_)(item, thread);
}

void ThreadPool::loop(Helper& helper, int thread) {
  std::uint64_t seen = 0;
  Clock::duration patience = least_patience;
  const auto called = [&] { return stop_ || round_ != seen; };
  for (;;) {
    helper.core = core_here();
    if (!soon(called, patience)) {
      std::unique_lock lock(mutex_);
      ++asleep_;
      helper.core = Helper::asleep;
      start_.wait(lock, called);
      --asleep_;
    }
    if (stop_) return;
    seen = round_;
    helper.settle();
    const Clock::time_point begun = Clock::now();
    take(thread);
    patience = patience_after(begun);
    if (--busy_ > 0) continue;
    const std::lock_guard lock(mutex_);
    done_.notify_one();
  }
}

void ThreadPool::run(int items, const std::function<void(int, int)>& work) {
  if (helpers_.empty() || items <= 1) {
    for (int i = 0; i < items; ++i) work(i, 0);
    return;
  }
  const Clock::time_point begun = Clock::now();
  const int here = core_here();
  for (const auto& helper : helpers_) helper->make_way(here);
  bool wake = false;
  {
    const std::lock_guard lock(mutex_);
    work_ = &work;
    items_ = items;
    next_ = 0;
    busy_ = static_cast<int>(helpers_.size());
    ++round_;
    wake = asleep_ > 0;
  }
  if (wake) start_.notify_all();
  take(0);
  const auto done = [&] { return busy_ == 0; };
  if (soon(done, patience_after(begun))) return;
  std::unique_lock lock(mutex_);
  done_.wait(lock, done);
}

}  // namespace gelflow
