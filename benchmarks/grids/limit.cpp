// Ranges in a grid by the traversal of Amanatides and Woo (1987), as fast as one core does it.
//   limit MAP WIDTH HEIGHT RAYS COUNT MAX_RANGE REPEATS: seconds of the fastest pass over COUNT rays
// MAP: bytes, 1 occupied, row 0 below. RAYS: float64 (x, y, angle) in cells and radians.
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <vector>

static float cast(const uint8_t* map, int width, int height, float x0, float y0, float dx, float dy,
                  float limit) {
  int x = static_cast<int>(x0), y = static_cast<int>(y0);
  if (x < 0 || y < 0 || x >= width || y >= height) return limit;
  const float inf = std::numeric_limits<float>::infinity();
  const int step_x = dx > 0 ? 1 : -1, step_y = dy > 0 ? 1 : -1;
  const float per_x = dx != 0 ? std::fabs(1 / dx) : inf, per_y = dy != 0 ? std::fabs(1 / dy) : inf;
  float next_x = dx != 0 ? (dx > 0 ? x + 1 - x0 : x0 - x) * per_x : inf;
  float next_y = dy != 0 ? (dy > 0 ? y + 1 - y0 : y0 - y) * per_y : inf;
  float length = 0;
  const uint8_t* cell = map + y * width + x;
  while (!*cell) {
    if (next_x < next_y) {
      length = next_x;
      next_x += per_x;
      x += step_x;
      cell += step_x;
      if (static_cast<unsigned>(x) >= static_cast<unsigned>(width)) return limit;
    } else {
      length = next_y;
      next_y += per_y;
      y += step_y;
      cell += step_y * width;
      if (static_cast<unsigned>(y) >= static_cast<unsigned>(height)) return limit;
    }
    if (length >= limit) return limit;
  }
  return length;
}

template <class T>
static std::vector<T> read(const char* path, size_t count) {
  std::vector<T> out(count);
  FILE* file = std::fopen(path, "rb");
  if (!file || std::fread(out.data(), sizeof(T), count, file) != count) std::exit(2);
  std::fclose(file);
  return out;
}

int main(int argc, char** argv) {
  if (argc != 8) return 2;
  const int width = std::atoi(argv[2]), height = std::atoi(argv[3]), count = std::atoi(argv[5]);
  const auto map = read<uint8_t>(argv[1], size_t(width) * height);
  const auto rays = read<double>(argv[4], size_t(count) * 3);
  const float limit = std::atof(argv[6]);
  double best = 1e9, sum = 0;
  for (int k = std::atoi(argv[7]); k > 0; --k) {
    const auto began = std::chrono::steady_clock::now();
    sum = 0;
    for (int i = 0; i < count; ++i) {
      const double* ray = &rays[3 * i];
      const float angle = ray[2];
      sum += cast(map.data(), width, height, ray[0], ray[1], std::cos(angle), std::sin(angle), limit);
    }
    best = std::min(best, std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count());
  }
  std::printf("%.9g %.9g\n", best, sum / count);
}
