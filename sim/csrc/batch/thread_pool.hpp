// A persistent thread pool for the loops over environments.
#pragma once

#include <functional>
#include <memory>

#include "batch/interruption.hpp"

namespace gelflow {

// How often this process is the child of a fork: threads of the parent do not exist in it.
int fork_count();

// Waking a thread takes longer than some steps, so idle workers and the waiting caller spin briefly before they sleep.
// After a fork the pool of the child starts workers of its own.
class ThreadPool {
 public:
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;
  int size() const { return threads_; }
  // Calls work(item, thread) for each item below `items`, and returns when all calls have returned. After an interruption
  // no further call begins.
  void run(int items, const std::function<void(int, int)>& work, Interruption& interruption);

 private:
  class Workers;
  const int threads_;
  int fork_count_;
  std::unique_ptr<Workers> workers_;
};

}  // namespace gelflow
