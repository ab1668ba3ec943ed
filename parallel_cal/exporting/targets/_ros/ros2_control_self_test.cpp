// Loads the plug-in by pluginlib, and compares it with Python's solutions of the model:
// self_test configurations.csv. Exit 1 if a number differs by more than 1e-9 (m, rad; relative
// where it is more than 1), or if a wrong call is not refused.
#include <memory>
#include <string>
#include <vector>

#include "configurations.hpp"

#include "ament_index_cpp/get_package_share_directory.hpp"
#include "kinematics_interface/kinematics_interface.hpp"
#include "pluginlib/class_loader.hpp"
#include "rclcpp/rclcpp.hpp"

using kinematics_interface::KinematicsInterface;

constexpr double limit = 1e-9;
const char base[] = "@base@", tip[] = "@tip@";

void compare_with_python(KinematicsInterface & robot, const std::vector<Row> & rows, Result & result)
{
  double position = 0, rotation = 0, forward = 0, inverse = 0, deltas = 0;
  for (const Row & row : rows) {
    const Eigen::VectorXd q = Eigen::VectorXd::Map(row.joints.data(), n_joints);
    Eigen::Isometry3d pose;
    result.check(robot.calculate_link_transform(q, tip, pose), "calculate_link_transform");
    for (int i = 0; i < 3; ++i) {
      result.compare(pose.translation()[i], row.position[i], limit, position);
      for (int j = 0; j < 3; ++j) {
        result.compare(pose.linear()(i, j), row.rotation[3 * i + j], limit, rotation);
      }
    }
    Eigen::Matrix<double, 6, Eigen::Dynamic> jacobian(6, n_joints);
    Eigen::Matrix<double, Eigen::Dynamic, 6> back(n_joints, 6);
    result.check(robot.calculate_jacobian(q, tip, jacobian), "calculate_jacobian");
    result.check(robot.calculate_jacobian_inverse(q, tip, back), "calculate_jacobian_inverse");
    Eigen::VectorXd change = 1e-3 * Eigen::VectorXd::LinSpaced(n_joints, 1, 2), returned = change;
    Eigen::Matrix<double, 6, 1> motion;
    result.check(
      robot.convert_joint_deltas_to_cartesian_deltas(q, change, tip, motion) &&
      robot.convert_cartesian_deltas_to_joint_deltas(q, motion, tip, returned), "deltas");
    const Eigen::VectorXd expected = back * (jacobian * change);
    for (std::size_t j = 0; j < n_joints; ++j) {
      result.compare(returned[j], expected[j], limit, deltas);
      for (int i = 0; i < 6; ++i) {
        result.compare(jacobian(i, j), row.jacobian[i * n_joints + j], limit, forward);
        result.compare(back(j, i), row.inverse_jacobian[6 * j + i], limit, inverse);
      }
    }
  }
  std::printf(
    "configurations %zu position %.3g rotation %.3g jacobian %.3g inverse_jacobian %.3g "
    "deltas %.3g\n", rows.size(), position, rotation, forward, inverse, deltas);
}

void check_refusals(KinematicsInterface & robot, const Row & row, Result & result)
{
  const Eigen::VectorXd q = Eigen::VectorXd::Map(row.joints.data(), n_joints);
  const Eigen::VectorXd longer = Eigen::VectorXd::Zero(n_joints + 1);
  const Eigen::VectorXd nan = Eigen::VectorXd::Constant(n_joints, NAN);
  Eigen::Isometry3d pose;
  Eigen::Matrix<double, 6, Eigen::Dynamic> narrow(6, n_joints + 1);
  result.check(!robot.calculate_link_transform(longer, tip, pose), "a wrong number of joints");
  result.check(!robot.calculate_link_transform(q, "no_such_link", pose), "an unknown link");
  result.check(!robot.calculate_link_transform(nan, tip, pose), "joints that are NaN");
  result.check(!robot.calculate_jacobian(q, tip, narrow), "a Jacobian of the wrong size");
  result.check(
    robot.calculate_link_transform(q, base, pose) && pose.isApprox(Eigen::Isometry3d::Identity()),
    "the base is at itself");
}

void check_parameters(
  pluginlib::ClassLoader<KinematicsInterface> & loader, const std::string & name,
  const rclcpp::Parameter & wrong, Result & result)
{
  auto options = rclcpp::NodeOptions().append_parameter_override(wrong.get_name(), wrong.get_parameter_value());
  options.automatically_declare_parameters_from_overrides(true);
  auto node = std::make_shared<rclcpp::Node>("wrong", options);
  auto robot = loader.createSharedInstance(name);
  result.check(
    !robot->initialize("", node->get_node_parameters_interface(), "kinematics"),
    "a wrong parameter " + wrong.get_name());
}

int main(int count, char ** words)
{
  rclcpp::init(0, nullptr);
  const std::string package = "@package@", name = package + "/Kinematics";
  const std::string table = count > 1 ? words[1] :
    ament_index_cpp::get_package_share_directory(package) + "/configurations.csv";
  const std::vector<Row> rows = read_rows(table);
  Result result;
  result.check(!rows.empty(), table + " has no rows");
  pluginlib::ClassLoader<KinematicsInterface> loader(
    "kinematics_interface", "kinematics_interface::KinematicsInterface");
  if (!rows.empty()) {
    auto options = rclcpp::NodeOptions().append_parameter_override("kinematics.tip", tip);
    options.automatically_declare_parameters_from_overrides(true);
    auto node = std::make_shared<rclcpp::Node>("self_test", options);
    auto robot = loader.createSharedInstance(name);
    result.check(
      robot->initialize("", node->get_node_parameters_interface(), "kinematics"), "initialize");
    compare_with_python(*robot, rows, result);
    check_refusals(*robot, rows.front(), result);
    check_parameters(loader, name, rclcpp::Parameter("kinematics.tip", "other"), result);
    check_parameters(
      loader, name, rclcpp::Parameter("joints", std::vector<std::string>{"other"}), result);
  }
  std::printf("failed %d\n", result.failed);
  rclcpp::shutdown();
  return result.failed > 0;
}
