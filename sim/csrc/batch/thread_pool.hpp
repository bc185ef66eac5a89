// A persistent thread pool for the loops over environments.
#pragma once

#include <atomic>
#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <vector>

namespace gelflow {

// Waking a thread takes longer than some steps, so idle workers and the waiting caller spin briefly before they sleep.
class ThreadPool {
 public:
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;
  int size() const;
  // Calls work(item, thread) for each item below `items`, and returns when all calls have returned.
  void run(int items, const std::function<void(int, int)>& work);

 private:
  struct Worker;
  void loop(Worker& worker, int thread);
  void work_on_items(int thread);
  std::vector<std::unique_ptr<Worker>> workers_;
  std::mutex mutex_;
  std::condition_variable start_, done_;
  const std::function<void(int, int)>* work_ = nullptr;
  std::atomic<int> next_{0};
  int items_ = 0;
  std::atomic<int> busy_{0};  // workers that have not finished this run
  std::atomic<std::uint64_t> run_count_{0};
  std::atomic<bool> stop_{false};
  int sleeping_ = 0;  // workers that wait for `start_`
};

}  // namespace gelflow
