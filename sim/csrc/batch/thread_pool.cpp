#include "batch/thread_pool.hpp"

#include <algorithm>
#include <chrono>
#include <thread>

#ifdef __linux__
#include <pthread.h>
#include <sched.h>
#endif

namespace gelflow {

namespace {

using Clock = std::chrono::steady_clock;

// Spin time before sleeping. A wake-up takes about 100 µs, much more on a virtual machine; the spin time is a share of
// the duration of the last work, within these bounds.
constexpr std::chrono::microseconds min_spin_time(100), max_spin_time(500);
constexpr int spin_share = 2;

Clock::duration spin_time_after(Clock::time_point start) {
  return std::clamp<Clock::duration>((Clock::now() - start) / spin_share, min_spin_time, max_spin_time);
}

// Spins until the condition holds, at most for that long; returns whether it holds.
template <class Condition>
bool spin_until(const Condition& condition, Clock::duration spin_time) {
  constexpr int checks_per_clock_read = 64;
  const Clock::time_point end = Clock::now() + spin_time;
  do {
    for (int i = 0; i < checks_per_clock_read; ++i) {
      if (condition()) return true;
#ifdef __x86_64__
      __builtin_ia32_pause();
#endif
    }
  } while (Clock::now() < end);
  return false;
}

int current_cpu() {
#ifdef __linux__
  return sched_getcpu();
#else
  return -1;
#endif
}

}  // namespace

// A worker on the caller's CPU competes with it, and Linux may leave it there for milliseconds while another CPU is idle.
// The caller therefore excludes its own CPU from the worker's affinity until the worker runs.
struct ThreadPool::Worker {
  std::thread thread;
  static constexpr int sleeping = -2;
  std::atomic<int> cpu{sleeping};  // where it began to spin

#ifdef __linux__
  void move_off(int caller_cpu) {
    if (cpu != caller_cpu && cpu != sleeping) return;
    if (sched_getaffinity(0, sizeof allowed_, &allowed_) != 0) return;
    cpu_set_t others = allowed_;
    CPU_CLR(caller_cpu, &others);
    if (CPU_COUNT(&others) == 0) return;
    restricted_ = pthread_setaffinity_np(thread.native_handle(), sizeof others, &others) == 0;
  }
  void restore_affinity() {
    if (restricted_.exchange(false)) pthread_setaffinity_np(pthread_self(), sizeof allowed_, &allowed_);
  }

 private:
  cpu_set_t allowed_;  // of the caller
  std::atomic<bool> restricted_{false};
#else
  void move_off(int) {}
  void restore_affinity() {}
#endif
};

ThreadPool::ThreadPool(int threads) {
  for (int i = 1; i < threads; ++i) {
    Worker& worker = *workers_.emplace_back(std::make_unique<Worker>());
    worker.thread = std::thread([this, &worker, i] { loop(worker, i); });
  }
}

ThreadPool::~ThreadPool() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  start_.notify_all();
  for (const auto& worker : workers_) worker->thread.join();
}

int ThreadPool::size() const { return static_cast<int>(workers_.size()) + 1; }

void ThreadPool::work_on_items(int thread) {
  for (int item = next_.fetch_add(1); item < items_; item = next_.fetch_add(1)) (*work_)(item, thread);
}

void ThreadPool::loop(Worker& worker, int thread) {
  std::uint64_t runs_seen = 0;
  Clock::duration spin_time = min_spin_time;
  const auto called = [&] { return stop_ || run_count_ != runs_seen; };
  for (;;) {
    worker.cpu = current_cpu();
    if (!spin_until(called, spin_time)) {
      std::unique_lock lock(mutex_);
      ++sleeping_;
      worker.cpu = Worker::sleeping;
      start_.wait(lock, called);
      --sleeping_;
    }
    if (stop_) return;
    runs_seen = run_count_;
    worker.restore_affinity();
    const Clock::time_point start = Clock::now();
    work_on_items(thread);
    spin_time = spin_time_after(start);
    if (--busy_ > 0) continue;
    const std::lock_guard lock(mutex_);
    done_.notify_one();
  }
}

void ThreadPool::run(int items, const std::function<void(int, int)>& work) {
  if (workers_.empty() || items <= 1) {
    for (int i = 0; i < items; ++i) work(i, 0);
    return;
  }
  const Clock::time_point start = Clock::now();
  const int cpu = current_cpu();
  for (const auto& worker : workers_) worker->move_off(cpu);
  bool wake = false;
  {
    const std::lock_guard lock(mutex_);
    work_ = &work;
    items_ = items;
    next_ = 0;
    busy_ = static_cast<int>(workers_.size());
    ++run_count_;
    wake = sleeping_ > 0;
  }
  if (wake) start_.notify_all();
  work_on_items(0);
  const auto done = [&] { return busy_ == 0; };
  if (spin_until(done, spin_time_after(start))) return;
  std::unique_lock lock(mutex_);
  done_.wait(lock, done);
}

}  // namespace gelflow
