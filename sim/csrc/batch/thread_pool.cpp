#include "batch/thread_pool.hpp"

#include <algorithm>
#include <condition_variable>
#include <mutex>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#ifdef __linux__
#include <sched.h>
#endif
#ifndef _WIN32
#include <pthread.h>
#endif

namespace gelflow {

namespace {

using Clock = std::chrono::steady_clock;

// Spin time before sleeping. A wake-up takes about 100 µs, much more on a virtual machine; the spin time is half
// the duration of the last work, within these bounds.
constexpr std::chrono::microseconds min_spin_time(100), max_spin_time(500);
constexpr int spin_divisor = 2;

Clock::duration spin_time_after(Clock::time_point start) {
  return std::clamp<Clock::duration>((Clock::now() - start) / spin_divisor, min_spin_time, max_spin_time);
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

std::atomic<int> forks{0};

int current_cpu() {
#ifdef __linux__
  return sched_getcpu();
#else
  return -1;
#endif
}

// A worker on the caller's CPU competes with it, and Linux may leave it there for milliseconds while another CPU is idle.
// The caller therefore excludes its own CPU from the worker's affinity until the worker runs.
struct Worker {
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

}  // namespace

int fork_count() {
#ifndef _WIN32
  static const int registered = pthread_atfork(nullptr, nullptr, [] { ++forks; });
  static_cast<void>(registered);
#endif
  return forks.load(std::memory_order_relaxed);
}

class ThreadPool::Workers {
 public:
  explicit Workers(int count) {
    for (int i = 1; i <= count; ++i) {
      Worker& worker = *workers_.emplace_back(std::make_unique<Worker>());
      try {
        worker.thread = std::thread([this, &worker, i] { loop(worker, i); });
      } catch (const std::system_error&) {
        workers_.pop_back();
        stop();
        throw std::invalid_argument("cannot start thread " + std::to_string(i + 1) + " of " +
                                    std::to_string(count + 1) + "; choose fewer threads");
      }
    }
  }
  ~Workers() { stop(); }
  void run(int items, const std::function<void(int, int)>& work, Interruption& interruption);

 private:
  void stop() {
    {
      const std::lock_guard lock(mutex_);
      stop_ = true;
    }
    start_.notify_all();
    for (const auto& worker : workers_) worker->thread.join();
  }
  void loop(Worker& worker, int thread);
  void work_on_items(int thread);
  std::vector<std::unique_ptr<Worker>> workers_;
  std::mutex mutex_;
  std::condition_variable start_, done_;
  const std::function<void(int, int)>* work_ = nullptr;
  Interruption* interruption_ = nullptr;
  std::atomic<int> next_{0};
  int items_ = 0;
  std::atomic<int> busy_{0};  // workers that have not finished this run
  std::atomic<std::uint64_t> run_count_{0};
  std::atomic<bool> stop_{false};
  int sleeping_ = 0;  // workers that wait for `start_`
};

void ThreadPool::Workers::work_on_items(int thread) {
  for (int item = next_.fetch_add(1); item < items_ && !interruption_->check(thread); item = next_.fetch_add(1)) {
    (*work_)(item, thread);
  }
}

void ThreadPool::Workers::loop(Worker& worker, int thread) {
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

void ThreadPool::Workers::run(int items, const std::function<void(int, int)>& work, Interruption& interruption) {
  const Clock::time_point start = Clock::now();
  const int cpu = current_cpu();
  for (const auto& worker : workers_) worker->move_off(cpu);
  bool wake = false;
  {
    const std::lock_guard lock(mutex_);
    work_ = &work;
    interruption_ = &interruption;
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
  while (!done_.wait_for(lock, Interruption::period, done)) {
    lock.unlock();
    interruption.ask();
    lock.lock();
  }
}

ThreadPool::ThreadPool(int threads) : threads_(std::max(threads, 1)), fork_count_(fork_count()) {
  if (threads_ > 1) workers_ = std::make_unique<Workers>(threads_ - 1);
}

// The workers of the parent of a fork, which the child cannot join, are never freed there.
ThreadPool::~ThreadPool() {
  if (fork_count() != fork_count_) static_cast<void>(workers_.release());
}

void ThreadPool::run(int items, const std::function<void(int, int)>& work, Interruption& interruption) {
  if (threads_ == 1 || items <= 1) {
    for (int i = 0; i < items && !interruption.check(0); ++i) work(i, 0);
    return;
  }
  if (fork_count() != fork_count_) {
    static_cast<void>(workers_.release());
    workers_ = std::make_unique<Workers>(threads_ - 1);
    fork_count_ = fork_count();
  }
  workers_->run(items, work, interruption);
}

}  // namespace gelflow
