// EKF-SLAM for the draws of a robot with velocities and a sensor of relative positions at its pose, as those
// of the worlds `circle` and `loop`. The state x is the robot's pose (x, y, theta), then (x, y) of each
// landmark in the order in which they are first measured; P is its covariance. Numbers in brackets are of
// J. Solà, "Simultaneous localization and mapping with the extended Kalman filter", 2014.
//
//     c++ -std=c++17 -O2 -o ekf_slam ekf_slam.cpp && ./ekf_slam draws/runs/0000 estimates/0000
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

using Row = std::vector<double>;
using Matrix = std::vector<Row>;

Matrix variances(const Row &sigma) {  // the diagonal matrix of squares
  Matrix A(sigma.size(), Row(sigma.size()));
  for (size_t i = 0; i < sigma.size(); ++i) A[i][i] = sigma[i] * sigma[i];
  return A;
}

Matrix transpose(const Matrix &A) {
  Matrix B(A[0].size(), Row(A.size()));
  for (size_t i = 0; i < A.size(); ++i)
    for (size_t j = 0; j < A[0].size(); ++j) B[j][i] = A[i][j];
  return B;
}

Matrix operator*(const Matrix &A, const Matrix &B) {
  Matrix C(A.size(), Row(B[0].size()));
  for (size_t i = 0; i < A.size(); ++i)
    for (size_t k = 0; k < B.size(); ++k)
      if (A[i][k] != 0)  // most entries of a Jacobian are 0
        for (size_t j = 0; j < B[0].size(); ++j) C[i][j] += A[i][k] * B[k][j];
  return C;
}

Matrix sum(Matrix A, const Matrix &B, double sign = 1) {
  for (size_t i = 0; i < A.size(); ++i)
    for (size_t j = 0; j < A[0].size(); ++j) A[i][j] += sign * B[i][j];
  return A;
}

Matrix carried(const Matrix &J, const Matrix &P) { return J * transpose(J * P); }  // J P J'
[[noreturn]] void fail(const std::string &why) { std::fprintf(stderr, "%s\n", why.c_str()), std::exit(1); }

Row numbers(const std::string &text) {  // of "1,2,3"
  Row values;
  std::istringstream cells(text);
  for (std::string cell; std::getline(cells, cell, ',');) values.push_back(std::stod(cell));
  return values;
}

Matrix table(const std::string &path, const std::string &header) {
  std::ifstream file(path);
  std::string line;
  if (!std::getline(file, line) || line != header) fail(path + ": expected " + header);
  Matrix rows;
  while (std::getline(file, line)) rows.push_back(numbers(line));
  return rows;
}

Row setting(const std::string &run, const std::string &section, const std::string &key) {
  std::ifstream file(run + "/dataset.toml");
  for (std::string line, current; std::getline(file, line); current = line[0] == '[' ? line : current)
    if (current == "[" + section + "]" && line.rfind(key + " = [", 0) == 0)
      return numbers(line.substr(key.size() + 4));
  fail(run + "/dataset.toml: expected a list " + key + " in [" + section + "]");
}

void save(const std::string &path, const std::string &header, const Matrix &rows) {
  std::ofstream file(path);
  file.precision(17);
  file << header << "\n";
  for (const Row &row : rows)
    for (size_t i = 0; i < row.size(); ++i) file << row[i] << (i + 1 < row.size() ? "," : "\n");
  if (!file.flush()) fail(path + ": cannot be written");
}

int main(int argc, char **argv) {
  if (argc != 3) fail("usage: ekf_slam RUN ESTIMATE");
  const std::string run = argv[1], estimate = argv[2];
  const Matrix odometry = table(run + "/odometry.csv", "t [s],v [m/s],omega [rad/s]");
  const Matrix measured = table(run + "/measurements.csv", "t [s],tag,ahead [m],left [m]");
  const Matrix Q = variances(setting(run, "motion", "noise")), R = variances(setting(run, "sensor", "noise"));
  Row x = setting(run, "filter", "start");
  Matrix P = variances(setting(run, "filter", "start_noise")), trajectory, map, innovations;
  std::map<double, size_t> place;  // in x, of the landmark with a tag
  for (size_t k = 0, next = 0; k + 1 < odometry.size(); ++k) {
    // Predict (14)-(17): the velocities of a row hold until the next.
    const double v = odometry[k][1], omega = odometry[k][2], t = odometry[k + 1][0], dt = t - odometry[k][0];
    double c = std::cos(x[2]), s = std::sin(x[2]);
    Matrix F = variances(Row(x.size(), 1)), G(x.size(), Row(2));
    F[0][2] = -v * dt * s, F[1][2] = v * dt * c, G[0][0] = dt * c, G[1][0] = dt * s, G[2][1] = dt;
    x[0] += v * dt * c, x[1] += v * dt * s, x[2] = std::remainder(x[2] + omega * dt, 2 * M_PI);
    P = sum(carried(F, P), carried(G, Q));

    // The scan: z = R(theta)' (l - p) of the landmarks l in the map; those of others wait.
    c = std::cos(x[2]), s = std::sin(x[2]);
    const size_t first = innovations.size();
    const Row x_hat = x;
    Matrix H, born;
    for (; next < measured.size() && measured[next][0] <= t; ++next) {
      const Row &z = measured[next];
      if (!place.count(z[1])) { born.push_back(z); continue; }
      const size_t l = place[z[1]];
      const double dx = x[l] - x[0], dy = x[l + 1] - x[1], ahead = c * dx + s * dy, left = c * dy - s * dx;
      Matrix H_z(2, Row(x.size()));
      H_z[0][0] = -c, H_z[0][1] = -s, H_z[0][2] = left, H_z[0][l] = c, H_z[0][l + 1] = s;
      H_z[1][0] = s, H_z[1][1] = -c, H_z[1][2] = -ahead, H_z[1][l] = -s, H_z[1][l + 1] = c;
      const Matrix S = sum(carried(H_z, P), R);
      H.insert(H.end(), H_z.begin(), H_z.end());
      innovations.push_back({t, z[1], z[2] - ahead, z[3] - left, S[0][0], S[0][1], S[1][1], 0, 0});
    }
    // Correct (26)-(30) by the whole scan: as R is diagonal, by one number after the other, all linearized
    // at x_hat. Their NIS and log-likelihood, each given the numbers before it, add up to those of the scan.
    for (size_t i = 0; i < H.size(); ++i) {
      const Matrix PH = P * transpose({H[i]});
      const double S = (Matrix{H[i]} * PH)[0][0] + R[i % 2][i % 2];
      Row &row = innovations[first + i / 2];
      double e = row[2 + i % 2];
      for (size_t j = 0; j < x.size(); ++j) e -= H[i][j] * (x[j] - x_hat[j]);
      for (size_t j = 0; j < x.size(); ++j) x[j] += PH[j][0] / S * e;
      P = sum(P, PH * transpose(PH), -1 / S);
      row[7] += e * e / S, row[8] -= (e * e / S + std::log(2 * M_PI * S)) / 2;
    }

    // New landmarks (31)-(38): l = p + R(theta) z.
    c = std::cos(x[2]), s = std::sin(x[2]);
    for (const Row &z : born) {
      const size_t l = place[z[1]] = x.size();
      const double dx = c * z[2] - s * z[3], dy = s * z[2] + c * z[3];
      Matrix J = variances(Row(l, 1)), Y(l, Row(2));
      J.resize(l + 2, Row(l));
      J[l][0] = J[l + 1][1] = 1, J[l][2] = -dy, J[l + 1][2] = dx;
      Y.push_back({c, -s}), Y.push_back({s, c});
      x.insert(x.end(), {x[0] + dx, x[1] + dy});
      P = sum(carried(J, P), carried(Y, R));
    }
    trajectory.push_back({t, x[0], x[1], x[2], P[0][0], P[0][1], P[0][2], P[1][1], P[1][2], P[2][2]});
  }
  for (const auto &[tag, l] : place)
    map.push_back({tag, x[l], x[l + 1], P[l][l], P[l][l + 1], P[l + 1][l + 1]});
  save(estimate + "/trajectory.csv", "time,x,y,theta,c_xx,c_xy,c_xt,c_yy,c_yt,c_tt", trajectory);
  save(estimate + "/map.csv", "landmark,x,y,c_xx,c_xy,c_yy", map);
  save(estimate + "/innovations.csv", "t,tag,nu_1,nu_2,s_11,s_12,s_22,nis,log_likelihood", innovations);
}
