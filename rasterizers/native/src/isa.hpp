// The instruction sets that this processor supports, by the names of the compiled modules.
#pragma once

#include <string>
#include <vector>

namespace clear {

inline std::vector<std::string> instruction_sets() {
  std::vector<std::string> names;
#if defined(__x86_64__)
  __builtin_cpu_init();
  bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
  bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
            __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd");
  if (v4) names.push_back("avx512");
  if (v3) names.push_back("avx2");
#endif
  return names;
}

}  // namespace clear
