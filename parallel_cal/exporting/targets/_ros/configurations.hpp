// Solutions by Python of the calibrated model, to compare a plug-in with.
#ifndef CONFIGURATIONS_HPP
#define CONFIGURATIONS_HPP

#include <array>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <sstream>
#include <string>
#include <vector>

#include "@package@/@robot@.hpp"

constexpr std::size_t n_joints = @robot@::n_joints;

// One row of configurations.csv.
struct Row
{
  std::array<double, n_joints> joints;
  std::array<double, 3> position;
  std::array<double, 9> rotation;
  std::array<double, 6 * n_joints> jacobian;
  std::array<double, n_joints * 6> inverse_jacobian;
};

inline std::vector<Row> read_rows(const std::string & path)
{
  std::vector<Row> rows;
  std::ifstream file(path);
  std::string line;
  std::getline(file, line);
  while (std::getline(file, line)) {
    std::istringstream cells(line);
    Row row{};
    const auto read = [&cells](auto & to) {
        std::string cell;
        for (double & value : to) {
          std::getline(cells, cell, ',');
          value = std::stod(cell);
        }
      };
    read(row.joints), read(row.position), read(row.rotation);
    read(row.jacobian), read(row.inverse_jacobian);
    rows.push_back(row);
  }
  return rows;
}

// Counts checks, and keeps the largest difference of each kind.
struct Result
{
  int failed = 0;

  void check(bool passed, const std::string & what)
  {
    if (passed) {return;}
    ++failed;
    if (failed <= 20) {std::printf("FAILED: %s\n", what.c_str());}
  }

  // |a - b| <= limit, or relative to |b| where this is more than 1.
  void compare(double a, double b, double limit, double & largest)
  {
    const double difference = std::fabs(a - b) / std::fmax(1.0, std::fabs(b));
    if (!(difference <= largest)) {largest = difference;}
    check(difference <= limit, "a number differs by " + std::to_string(difference));
  }
};

#endif
