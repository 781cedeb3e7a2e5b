// A thread pool for the compiled kernels. OpenMP would share, or duplicate, the pool of whichever library was imported
// first, and its waiting threads spin: two such pools on two cores run ten times slower.
//
// A counter hands out the tasks, and each task writes to places of its own, so results do not depend on which thread ran it.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <type_traits>
#include <vector>
#if defined(__unix__) || defined(__APPLE__)
#include <unistd.h>
#endif

namespace clear {

class Pool {
 public:
  // The process's pool. A forked child gets a new one, because threads do not survive a fork.
  static Pool& instance() {
    static std::atomic<Pool*> pool{nullptr};
    static std::mutex making;
    Pool* p = pool.load(std::memory_order_acquire);
    if (p && p->process_ == process()) return *p;
    std::lock_guard<std::mutex> lock(making);
    p = pool.load(std::memory_order_acquire);
    if (!p || p->process_ != process()) pool.store(p = new Pool, std::memory_order_release);  // never deleted
    return *p;
  }

  // Runs task(0) … task(n - 1) on up to `threads` threads, including the caller's. If the pool is busy (another Python
  // thread uses it, or a task calls `run`), the caller runs all tasks itself. Rethrows the first exception.
  template <class Task>
  void run(int threads, std::int64_t n, Task&& task) {
    run(threads, n, [](const void* one, std::int64_t i) { (*static_cast<const std::remove_reference_t<Task>*>(one))(i); }, &task);
  }

 private:
  // Compiled once, not for every task.
  __attribute__((noinline)) void run(int threads, std::int64_t n, void (*call)(const void*, std::int64_t), const void* task) {
    std::unique_lock<std::mutex> only(running_, std::try_to_lock);
    if (threads <= 1 || n <= 1 || !only.owns_lock()) {
      for (std::int64_t i = 0; i < n; ++i) call(task, i);
      return;
    }
    std::function<void()> work = [&] {
      for (std::int64_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < n;) {
        try {
          call(task, i);
        } catch (...) {
          std::lock_guard<std::mutex> lock(mutex_);
          if (!failure_) failure_ = std::current_exception();
          next_.store(n, std::memory_order_relaxed);
        }
      }
    };
    int helpers = int(std::min<std::int64_t>(threads, n)) - 1;
    while (int(workers_.size()) < helpers) {
      int index = int(workers_.size());
      workers_.emplace_back([this, index] { serve(index); });
      workers_.back().detach();
    }
    {
      std::lock_guard<std::mutex> lock(mutex_);
      next_ = 0;
      failure_ = nullptr;
      work_ = &work;
      helpers_ = helpers;
      pending_ = helpers;
      round_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    work();
    for (int spins = 0; pending_.load(std::memory_order_acquire) && spins < kSpins; ++spins) pause();
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [&] { return pending_.load(std::memory_order_acquire) == 0; });
    if (failure_) std::rethrow_exception(failure_);
  }

  static constexpr int kSpins = 2000;  // about 50 µs: stages follow each other closely, and waking a sleeping thread takes longer

  static long process() {
#if defined(__unix__) || defined(__APPLE__)
    return long(getpid());
#else
    return 0;
#endif
  }
  static void pause() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("isb");  // takes about as long; yield takes no time
#endif
  }

  void serve(int index) {
    std::uint64_t last_round = 0;
    for (;;) {
      for (int spins = 0; round_.load(std::memory_order_acquire) == last_round && spins < kSpins; ++spins) pause();
      std::function<void()>* work;
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return round_.load(std::memory_order_acquire) != last_round; });
        last_round = round_.load(std::memory_order_acquire);
        if (index >= helpers_) continue;
        work = work_;
      }
      (*work)();
      if (pending_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
        std::lock_guard<std::mutex> lock(mutex_);
        done_.notify_one();
      }
    }
  }

  long process_ = process();
  std::mutex running_, mutex_;
  std::condition_variable wake_, done_;
  std::vector<std::thread> workers_;
  std::function<void()>* work_ = nullptr;
  std::exception_ptr failure_;
  std::atomic<std::int64_t> next_{0};
  std::atomic<int> pending_{0};
  std::atomic<std::uint64_t> round_{0};
  int helpers_ = 0;
};

}  // namespace clear
