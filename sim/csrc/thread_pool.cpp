#include "batch.hpp"

namespace gelflow {

namespace {

// Looks out for some 100 µs. Whether it came true.
template <class Condition>
bool soon(const Condition& condition) {
  constexpr int looks = 2500;
  for (int i = 0; i < looks; ++i) {
    if (condition()) return true;
#ifdef __x86_64__
    __builtin_ia32_pause();
#endif
  }
  return false;
}

}  // namespace

ThreadPool::ThreadPool(int threads) {
  for (int i = 1; i < threads; ++i) threads_.emplace_back([this, i] { loop(i); });
}

ThreadPool::~ThreadPool() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  start_.notify_all();
  for (auto& thread : threads_) thread.join();
}

void ThreadPool::take(int thread) {
  for (int item = next_.fetch_add(1); item < items_; item = next_.fetch_add(1)) (*work_)(item, thread);
}

void ThreadPool::loop(int thread) {
  std::uint64_t seen = 0;
  const auto called = [&] { return stop_ || round_ != seen; };
  for (;;) {
    if (!soon(called)) {
      std::unique_lock lock(mutex_);
      ++asleep_;
      start_.wait(lock, called);
      --asleep_;
    }
    if (stop_) return;
    seen = round_;
    take(thread);
    if (--busy_ > 0) continue;
    const std::lock_guard lock(mutex_);
    done_.notify_one();
  }
}

void ThreadPool::run(int items, const std::function<void(int, int)>& work) {
  if (threads_.empty() || items <= 1) {
    for (int i = 0; i < items; ++i) work(i, 0);
    return;
  }
  bool wake = false;
  {
    const std::lock_guard lock(mutex_);
    work_ = &work;
    items_ = items;
    next_ = 0;
    busy_ = static_cast<int>(threads_.size());
    ++round_;
    wake = asleep_ > 0;
  }
  if (wake) start_.notify_all();
  take(0);
  const auto done = [&] { return busy_ == 0; };
  if (soon(done)) return;
  std::unique_lock lock(mutex_);
  done_.wait(lock, done);
}

}  // namespace gelflow
