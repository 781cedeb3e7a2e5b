// Large uninitialised arrays whose memory is reused.
//
// A frame's arrays live for one iteration, and the next one needs nearly the same sizes. Fresh pages from the system cost
// more than what is computed in them, so freed blocks are kept for the next request. A request that none of them fits takes the
// place of one that has become too small: as the Gaussians grow in number, the blocks grow in size and not in number.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>
#include <utility>
#include <vector>
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace clear {

class Recycler {
 public:
  struct Block {
    void* data = nullptr;
    std::size_t bytes = 0;
  };

  static Recycler& instance() {
    static Recycler* it = new Recycler;  // never destroyed: buffers may outlive static objects
    return *it;
  }

  // A block of at least `bytes`, at most about twice that. The address sanitizer gets exact blocks, and none is kept.
  __attribute__((noinline)) Block take(std::size_t bytes) {
#if defined(__SANITIZE_ADDRESS__)
    const std::size_t exact = (bytes + 127) / 128 * 128;  // a register of float64 has 128 bytes
    Block block{std::aligned_alloc(128, exact), exact};
    if (!block.data) throw std::bad_alloc();
    return block;
#endif
    {
      std::lock_guard<std::mutex> lock(mutex_);
      std::size_t best = kept_.size(), outgrown = kept_.size();
      for (std::size_t i = 0; i < kept_.size(); ++i) {
        const std::size_t here = kept_[i].bytes;
        if (here >= bytes && here <= 2 * bytes + kPage && (best == kept_.size() || here < kept_[best].bytes)) best = i;
        if (here < bytes && 2 * here >= bytes && (outgrown == kept_.size() || here > kept_[outgrown].bytes)) outgrown = i;
      }
      if (best < kept_.size()) return removed(best);
      if (outgrown < kept_.size()) std::free(removed(outgrown).data);
    }
    const std::size_t align = bytes >= kHuge ? kHuge : kPage;
    Block fresh{nullptr, (bytes + bytes / 8 + align) / align * align};  // some more than asked: the next request may be a little larger
    fresh.data = std::aligned_alloc(align, fresh.bytes);
    if (!fresh.data) throw std::bad_alloc();
#if defined(__linux__)
    if (align == kHuge) madvise(fresh.data, fresh.bytes, MADV_HUGEPAGE);  // random reads: fewer TLB misses
#endif
    return fresh;
  }

  __attribute__((noinline)) void give(Block block) noexcept {
    if (!block.data) return;
#if defined(__SANITIZE_ADDRESS__)
    std::free(block.data);
    return;
#endif
    std::lock_guard<std::mutex> lock(mutex_);
    if (block.bytes < kPage || held_ + block.bytes > kMost) {
      std::free(block.data);
    } else {
      held_ += block.bytes;
      kept_.push_back(block);
    }
  }

  // Frees the blocks that no buffer has.
  void release() noexcept {
    std::lock_guard<std::mutex> lock(mutex_);
    while (!kept_.empty()) std::free(removed(kept_.size() - 1).data);
  }

  // Bytes kept for later requests.
  std::size_t held() {
    std::lock_guard<std::mutex> lock(mutex_);
    return held_;
  }

 private:
  Block removed(std::size_t i) {
    const Block block = kept_[i];
    kept_.erase(kept_.begin() + std::ptrdiff_t(i));
    held_ -= block.bytes;
    return block;
  }

  static constexpr std::size_t kPage = 4096, kHuge = std::size_t(2) << 20, kMost = std::size_t(1) << 30;
  std::mutex mutex_;
  std::vector<Block> kept_;
  std::size_t held_ = 0;
};

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  Buffer(Buffer&& other) noexcept { *this = std::move(other); }
  Buffer& operator=(Buffer&& other) noexcept {
    std::swap(block_, other.block_);
    std::swap(size_, other.size_);
    return *this;
  }
  ~Buffer() { Recycler::instance().give(block_); }

  // Makes room for n numbers; the contents are lost if it has to grow.
  void reserve_lost(std::size_t n) {
    if (n * sizeof(T) > block_.bytes) {
      Recycler::instance().give(std::exchange(block_, {}));
      block_ = Recycler::instance().take(n * sizeof(T));
    }
    size_ = n;
  }
  T* data() { return static_cast<T*>(block_.data); }
  const T* data() const { return static_cast<const T*>(block_.data); }
  T& operator[](std::size_t i) { return data()[i]; }
  const T& operator[](std::size_t i) const { return data()[i]; }
  std::size_t size() const { return size_; }

 private:
  Recycler::Block block_;
  std::size_t size_ = 0;
};

}  // namespace clear
