// The cloister workload in MRPT's CRangeBearingKFSLAM2D, identities given, one thread.
// Usage: mrpt_slam [runs] [steps]; prints seconds a run in the filter, and the mean final error in metres.
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservationBearingRange.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/poses/CPosePDFGaussian.h>
#include <mrpt/slam/CRangeBearingKFSLAM2D.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <random>
#include <vector>

struct Point {
  double x, y;
};

// 36 columns on two squares 8 m and 16/3 m wide, in a grid of 7 × 7 without its corners.
static std::vector<Point> cloister() {
  std::vector<Point> side, all;
  const double unit = 8.0 / 6.0;
  for (int i = 0; i < 5; i++) side.push_back({unit * (i - 2), unit * 3});
  for (int i = 0; i < 4; i++) side.push_back({unit * (i - 2), unit * 2});
  for (int quarter = 0; quarter < 4; quarter++)
    for (Point p : side) {
      for (int k = 0; k < quarter; k++) p = {-p.y, p.x};
      all.push_back(p);
    }
  return all;
}

int main(int argc, char** argv) {
  using namespace mrpt;
  const int runs = argc > 1 ? std::atoi(argv[1]) : 10;
  const int steps = argc > 2 ? std::atoi(argv[2]) : 200;
  const double forward = 0.1, turn = 0.05, sigma_forward = 0.01, sigma_turn = 0.02;
  const double sigma_range = 0.1, sigma_bearing = M_PI / 180;
  const auto columns = cloister();
  std::mt19937_64 generator(1);
  std::normal_distribution<double> normal;
  double seconds = 0, error = 0;
  for (int run = 0; run < runs; run++) {
    slam::CRangeBearingKFSLAM2D filter;
    filter.options.std_sensor_range = sigma_range;
    filter.options.std_sensor_yaw = sigma_bearing;
    filter.KF_options.method = bayes::kfEKFNaive;
    filter.KF_options.verbosity_level = system::LVL_ERROR;
    double x = 0, y = -2, heading = 0;
    for (int t = 0; t < steps; t++) {
      x += forward * std::cos(heading);
      y += forward * std::sin(heading);
      heading += turn;
      // What the filter is told: an increment with the odometer's covariance, in the robot's own frame.
      math::CMatrixDouble33 cov;
      cov.setZero();
      cov(0, 0) = sigma_forward * sigma_forward;
      cov(1, 1) = 1e-12;
      cov(2, 2) = sigma_turn * sigma_turn;
      const poses::CPose2D said(forward + sigma_forward * normal(generator), 0.0,
                                turn + sigma_turn * normal(generator));
      obs::CActionRobotMovement2D moved;
      moved.estimationMethod = obs::CActionRobotMovement2D::emScan2DMatching;
      moved.poseChange = std::make_shared<poses::CPosePDFGaussian>(said, cov);
      auto action = std::make_shared<obs::CActionCollection>();
      action->insert(moved);
      // One new landmark a step; the others are measured as soon as they are known.
      auto seen = std::make_shared<obs::CObservationBearingRange>();
      seen->maxSensorDistance = 100;
      for (int i = 0; i < std::min<int>(t + 1, columns.size()); i++) {
        obs::CObservationBearingRange::TMeasurement one;
        const double dx = columns[i].x - x, dy = columns[i].y - y;
        one.range = std::hypot(dx, dy) + sigma_range * normal(generator);
        one.yaw = math::wrapToPi(std::atan2(dy, dx) - heading + sigma_bearing * normal(generator));
        one.pitch = 0;
        one.landmarkID = i;
        seen->sensedData.push_back(one);
      }
      auto frame = std::make_shared<obs::CSensoryFrame>();
      frame->insert(seen);
      const auto began = std::chrono::steady_clock::now();
      filter.processActionObservation(action, frame);
      seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count();
    }
    poses::CPosePDFGaussian found;
    filter.getCurrentRobotPose(found);
    error += std::hypot(found.mean.x() - x, found.mean.y() - (y + 2));  // its origin is the start
  }
  std::printf("%.6f %.4f\n", seconds / runs, error / runs);
}
