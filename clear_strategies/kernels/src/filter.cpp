// The nearest camera's depth of each Gaussian, from which training/mip.py makes the 3D filter. Compiled with
// -ffp-contract=off: products and sums round as in torch.
#include "filter.hpp"

#include <limits>

#include "block.hpp"
#include "pool.hpp"

namespace clear {

void nearest_depths(const float* means, std::int64_t n, const float* cameras, std::int64_t count, float near, float* depths,
                    int threads) {
  Pool::instance().run(threads, chunks(n), [&](std::int64_t number) {
    each_sixteen(n, number, [&](std::int64_t i, int lanes) CLEAR_LAMBDA {
      Floats p[3], nearest = std::numeric_limits<float>::infinity();
      load_columns(means + 3 * i, lanes, p);
      for (const float* c = cameras; c < cameras + count * kCameraNumbers; c += kCameraNumbers) {
        auto in_camera = [&](const float* row) CLEAR_LAMBDA {
          return p[0] * Floats(row[0]) + p[1] * Floats(row[1]) + p[2] * Floats(row[2]) + Floats(row[3]);
        };
        Floats z = in_camera(c + 8);
        auto nearer = (z > Floats(near)) & (z < nearest);
        if (!nearer.any()) continue;
        Floats u = Floats(c[12]) * in_camera(c) / z + Floats(c[14]), v = Floats(c[13]) * in_camera(c + 4) / z + Floats(c[15]);
        auto inside = (u >= Floats(c[16])) & (u <= Floats(c[17])) & (v >= Floats(c[18])) & (v <= Floats(c[19]));
        nearest = select(nearer & inside, z, nearest);
      }
      store_some(depths + i, nearest, lanes);
    });
  });
}

}  // namespace clear
