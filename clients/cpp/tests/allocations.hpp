// SPDX-License-Identifier: Apache-2.0
//
// Counts allocations by operator new, malloc and the C library between two points. Include it in one file of a program.
// It uses the hooks of AddressSanitizer, or else replaces glibc's malloc.

#ifndef LIPSERVE_TESTS_ALLOCATIONS_HPP
#define LIPSERVE_TESTS_ALLOCATIONS_HPP

#include <cstddef>
#include <cstdlib>

namespace allocations {

inline bool counting = false;
inline unsigned long count = 0;

/// Counts allocations during its lifetime.
struct Watch {
  Watch() { counting = true; }
  ~Watch() { counting = false; }
};

inline void note() {
  if (counting) ++count;
}

}  // namespace allocations

#if defined(__SANITIZE_ADDRESS__)
#define LIPSERVE_HOOKS 1
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define LIPSERVE_HOOKS 1
#endif
#endif

#ifdef LIPSERVE_HOOKS
extern "C" int __sanitizer_install_malloc_and_free_hooks(void (*allocated)(const volatile void*, std::size_t),
                                                         void (*freed)(const volatile void*));
#elif defined(__GLIBC__)
extern "C" {
void* __libc_malloc(std::size_t size);
void* __libc_calloc(std::size_t count, std::size_t size);
void* __libc_realloc(void* old, std::size_t size);
void* malloc(std::size_t size) noexcept { return allocations::note(), __libc_malloc(size); }
void* calloc(std::size_t count, std::size_t size) noexcept { return allocations::note(), __libc_calloc(count, size); }
void* realloc(void* old, std::size_t size) noexcept { return allocations::note(), __libc_realloc(old, size); }
}
#endif

namespace allocations {

/// Start to count; return false if that is not possible on this system. Call it first.
inline bool able() {
#ifdef LIPSERVE_HOOKS
  __sanitizer_install_malloc_and_free_hooks([](const volatile void*, std::size_t) { note(); },
                                            [](const volatile void*) {});
#endif
  void* (*volatile allocate)(std::size_t) = std::malloc;  // volatile: the compiler must not remove the call
  {
    const Watch watch;
    std::free(allocate(100));
  }
  const bool seen = count == 1;
  count = 0;
  return seen;
}

}  // namespace allocations

#endif  // LIPSERVE_TESTS_ALLOCATIONS_HPP
