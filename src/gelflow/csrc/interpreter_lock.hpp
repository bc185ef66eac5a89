// Python's global interpreter lock, for all extensions.
#pragma once

#include <Python.h>

#include <chrono>
#include <thread>

namespace gelflow {

// The interpreter's lock is released while an object of this class exists. Python ends a thread that wants the lock after
// the interpreter has shut down: it unwinds the stack, which aborts the process at a destructor such as that of
// pybind11's gil_scoped_release. Here the thread waits for the end of the process instead.
class WithoutInterpreterLock {
 public:
  WithoutInterpreterLock() = default;
  WithoutInterpreterLock(const WithoutInterpreterLock&) = delete;
  WithoutInterpreterLock& operator=(const WithoutInterpreterLock&) = delete;
  ~WithoutInterpreterLock() {
    try {
      PyEval_RestoreThread(thread_);
    } catch (...) {
      for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
    }
  }

 private:
  PyThreadState* thread_ = PyEval_SaveThread();
};

}  // namespace gelflow
