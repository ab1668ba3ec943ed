// Loads the plug-in by pluginlib into a MoveIt robot model, and compares it with Python's solutions
// of the calibrated model: self_test configurations.csv [robot.urdf]. Exit 1 if a number differs by
// more than 1e-9 (m, rad), if a limit, seed, timeout or tolerance is not honoured, or if the plug-in
// refuses the robot description.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <fstream>
#include <iterator>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "configurations.hpp"

#include "@package@/@robot@_solver.hpp"

#include "ament_index_cpp/get_package_share_directory.hpp"
#include "moveit/kinematics_base/kinematics_base.hpp"
#include "moveit/robot_model/robot_model.hpp"
#include "pluginlib/class_loader.hpp"
#include "rclcpp/rclcpp.hpp"
#include "srdfdom/model.h"
#include "urdf_parser/urdf_parser.h"

using geometry_msgs::msg::Pose;
using kinematics::KinematicsBase;
using moveit_msgs::msg::MoveItErrorCodes;
using Numbers = std::vector<double>;

constexpr double limit = 1e-9;  // m, rad
constexpr double timeout = 0.05;  // s
constexpr double late = 0.5;  // s that a search may take beyond its timeout on a busy machine
const std::string base = "@base@", tip = "@tip@", group = "robot";
const bool slides[n_joints] = {@slides@};
const bool far_is_out_of_reach = @out_of_reach@;  // as Python's solver says
const bool controls[6] = {@controlled@};  // x y z rx ry rz

// A robot description with these joints; its links are nowhere in particular.
std::string describe(const @robot@::Solver & limits)
{
  std::string text = "<robot name='robot'><link name='" + base + "'/><link name='" + tip +
    "'/><joint name='to_tip' type='fixed'><parent link='" + base + "'/><child link='" + tip +
    "'/></joint>";
  for (std::size_t i = 0; i < n_joints; ++i) {
    const std::string name = @robot@::c::@robot@_joint_names[i], link = "link_of_" + name;
    const bool bounded = std::isfinite(limits.low[i]) && std::isfinite(limits.high[i]);
    const std::string kind = slides[i] ? "prismatic" : bounded ? "revolute" : "continuous";
    char bounds[200] = "<limit effort='1' velocity='1' lower='-1e6' upper='1e6'/>";
    if (bounded) {
      std::snprintf(
        bounds, sizeof bounds, "<limit effort='1' velocity='1' lower='%.17g' upper='%.17g'/>",
        limits.low[i], limits.high[i]);
    }
    text += "<link name='" + link + "'/><joint name='" + name + "' type='" + kind +
      "'><parent link='" + base + "'/><child link='" + link + "'/><axis xyz='0 0 1'/>" + bounds +
      "</joint>";
  }
  return text + "</robot>";
}

// A loaded plug-in, and the robot model that it refers to.
struct Loaded
{
  moveit::core::RobotModelPtr model;
  std::shared_ptr<KinematicsBase> robot;
  bool initialized = false;
};

Loaded load(
  pluginlib::ClassLoader<KinematicsBase> & loader, const std::string & urdf_text,
  const rclcpp::NodeOptions & options = rclcpp::NodeOptions(), const std::string & missing = "")
{
  Loaded loaded;
  const urdf::ModelInterfaceSharedPtr urdf = urdf::parseURDF(urdf_text);
  std::string srdf_text = "<robot name='robot'><group name='" + group + "'>";
  for (const char * name : @robot@::c::@robot@_joint_names) {
    if (name != missing) {srdf_text += "<joint name='" + std::string(name) + "'/>";}
  }
  if (!missing.empty()) {srdf_text += "<joint name='to_tip'/>";}
  auto srdf = std::make_shared<srdf::Model>();
  srdf->initString(*urdf, srdf_text + "</group></robot>");
  loaded.model = std::make_shared<moveit::core::RobotModel>(urdf, srdf);
  loaded.robot = loader.createSharedInstance("@package@/Kinematics");
  // MoveIt passes the frames of the group's first and last link, which are not those of the model.
  loaded.initialized = loaded.robot->initialize(
    std::make_shared<rclcpp::Node>("self_test", options), *loaded.model, group, "some_base",
    {"some_tip"}, 0.1);
  return loaded;
}

double distance(const Numbers & a, const Numbers & b)
{
  double most = a.size() == b.size() ? 0 : HUGE_VAL;
  for (std::size_t i = 0; i < std::min(a.size(), b.size()); ++i) {
    most = std::fmax(most, std::fabs(a[i] - b[i]));
  }
  return most;
}

Pose forward(const KinematicsBase & robot, const Numbers & joints, Result & result)
{
  std::vector<Pose> poses;
  result.check(robot.getPositionFK({tip}, joints, poses) && poses.size() == 1, "getPositionFK");
  return poses.empty() ? Pose() : poses.front();
}

// Rotation matrix, row by row.
std::vector<double> matrix(const Pose & pose)
{
  const double x = pose.orientation.x, y = pose.orientation.y, z = pose.orientation.z;
  const double w = pose.orientation.w;
  return {
    w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z};
}

void compare_with_python(const KinematicsBase & robot, const std::vector<Row> & rows, Result & result)
{
  double position = 0, rotation = 0, joints = 0, again = 0;
  for (const Row & row : rows) {
    const Numbers q(row.joints.begin(), row.joints.end());
    const Pose pose = forward(robot, q, result);
    const double at[3] = {pose.position.x, pose.position.y, pose.position.z};
    const std::vector<double> R = matrix(pose);
    for (int i = 0; i < 3; ++i) {result.compare(at[i], row.position[i], limit, position);}
    for (int i = 0; i < 9; ++i) {result.compare(R[i], row.rotation[i], limit, rotation);}
    Numbers found;
    MoveItErrorCodes code;
    // The seed selects the branch.
    result.check(
      robot.getPositionIK(pose, q, found, code) && code.val == MoveItErrorCodes::SUCCESS,
      "getPositionIK from the solution: code " + std::to_string(code.val));
    result.check(distance(found, q) <= limit, "joints");
    joints = std::fmax(joints, distance(found, q));
    const Pose back = forward(robot, found, result);
    const double difference[] = {
      back.position.x - at[0], back.position.y - at[1], back.position.z - at[2]};
    for (double d : difference) {result.compare(d, 0, limit, again);}
  }
  std::printf(
    "configurations %zu position %.3g rotation %.3g joints %.3g position_again %.3g\n",
    rows.size(), position, rotation, joints, again);
}

double now()
{
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

void check_unreachable(const KinematicsBase & robot, const Row & row, Result & result)
{
  const Numbers q(row.joints.begin(), row.joints.end());
  Pose far = forward(robot, q, result);
  far.position.x += 10 * @length@, far.position.z += 10 * @length@;
  Numbers found;
  MoveItErrorCodes code;
  if (far_is_out_of_reach) {
    result.check(
      !robot.getPositionIK(far, q, found, code) && code.val == MoveItErrorCodes::NO_IK_SOLUTION &&
      found.empty(), "a pose out of reach has no solution");
    const double begin = now();
    result.check(
      !robot.searchPositionIK(far, q, timeout, found, code) &&
      code.val == MoveItErrorCodes::TIMED_OUT, "a search out of reach ends by its timeout");
    const double lapse = now() - begin;
    result.check(lapse >= timeout && lapse < timeout + late, "duration of a search");
    std::printf("out of reach: search of %g s took %.4f s\n", timeout, lapse);
  }
  Pose bad = forward(robot, q, result);
  bad.orientation.w += 1;
  result.check(!robot.getPositionIK(bad, q, found, code), "a quaternion that is not of length 1");
  bad = forward(robot, q, result);
  bad.position.x = NAN;
  result.check(!robot.getPositionIK(bad, q, found, code), "a position that is NaN");
  const Pose pose = forward(robot, q, result);
  result.check(!robot.getPositionIK(pose, Numbers(n_joints + 1), found, code), "a seed of wrong size");
  std::vector<Pose> poses;
  result.check(!robot.getPositionFK({"no_such_link"}, q, poses), "an unknown link");
}

// MoveIt finds the solver of a group, and sets the state of the tip by it.
void check_group(
  pluginlib::ClassLoader<KinematicsBase> & loader, const std::string & urdf, Result & result)
{
  const Loaded loaded = load(loader, urdf);
  result.check(loaded.initialized, "initialize with the robot description");
  std::map<std::string, moveit::core::SolverAllocatorFn> solvers;
  solvers[group] = [&loaded](const moveit::core::JointModelGroup *) {return loaded.robot;};
  loaded.model->setKinematicsAllocators(solvers);
  const moveit::core::JointModelGroup * joints = loaded.model->getJointModelGroup(group);
  result.check(
    joints && joints->canSetStateFromIK(tip) &&
    joints->getKinematicsSolverJointBijection().size() == n_joints, "the solver of the group");
}

// Consistency with the seed, and the callback.
void check_search(const KinematicsBase & robot, const Row & row, Result & result)
{
  const Numbers q(row.joints.begin(), row.joints.end());
  const Pose pose = forward(robot, q, result);
  Numbers far = q, found;
  for (double & joint : far) {joint += 0.02;}
  MoveItErrorCodes code;
  result.check(
    !robot.searchPositionIK(pose, far, timeout, Numbers(n_joints, 0.001), found, code),
    "a solution further from the seed than the consistency limits");
  result.check(
    robot.searchPositionIK(pose, q, timeout, Numbers(n_joints, 0.001), found, code) &&
    distance(found, q) <= 0.001, "a solution within the consistency limits");
  int asked = 0;
  const auto second = [&asked](const Pose &, const Numbers &, MoveItErrorCodes & answer) {
      answer.val = ++asked < 2 ? MoveItErrorCodes::GOAL_IN_COLLISION : MoveItErrorCodes::SUCCESS;
    };
  result.check(
    robot.searchPositionIK(pose, q, 10.0, found, second, code) && asked == 2 &&
    code.val == MoveItErrorCodes::SUCCESS, "a callback that accepts the second solution");
  const auto never = [](const Pose &, const Numbers &, MoveItErrorCodes & answer) {
      answer.val = MoveItErrorCodes::GOAL_IN_COLLISION;
    };
  result.check(
    !robot.searchPositionIK(pose, q, timeout, found, never, code) &&
    code.val == MoveItErrorCodes::TIMED_OUT, "a callback that accepts nothing");
}

// Narrower limits of the robot description are kept; limits of the model hold without any.
void check_limits(
  pluginlib::ClassLoader<KinematicsBase> & loader, const Row & row, Result & result)
{
  const Numbers q(row.joints.begin(), row.joints.end());
  @robot@::Solver narrow;
  for (std::size_t i = 0; i < n_joints; ++i) {
    narrow.low[i] = q[i] - 0.2, narrow.high[i] = q[i] + 0.2;
  }
  narrow.high[0] = q[0] - 0.01;
  const Loaded other = load(loader, describe(narrow));
  result.check(other.initialized, "initialize with narrower limits");
  const Pose pose = forward(*other.robot, q, result);
  Numbers found;
  MoveItErrorCodes code;
  for (double duration : {0.0, timeout}) {
    if (other.robot->searchPositionIK(pose, q, duration, found, code)) {
      for (std::size_t i = 0; i < n_joints; ++i) {
        result.check(found[i] >= narrow.low[i] && found[i] <= narrow.high[i], "limits");
      }
      result.check(!@unique@, "joints beyond the limits of the robot description");
    }
  }
}

// Turn a pose by 0.2 rad in what the robot does not control of its orientation.
void turn_uncontrolled(Pose & pose)
{
  double v[3], size = 0;
  for (int i = 0; i < 3; ++i) {
    v[i] = controls[3 + i] ? 0 : 1;
    size += v[i];
  }
  for (double & part : v) {part *= std::sin(0.1) / std::sqrt(size);}
  const auto o = pose.orientation;
  const double c = std::cos(0.1);
  pose.orientation.w = c * o.w - v[0] * o.x - v[1] * o.y - v[2] * o.z;
  pose.orientation.x = c * o.x + v[0] * o.w + v[1] * o.z - v[2] * o.y;
  pose.orientation.y = c * o.y + v[1] * o.w + v[2] * o.x - v[0] * o.z;
  pose.orientation.z = c * o.z + v[2] * o.w + v[0] * o.y - v[1] * o.x;
}

// What the robot does not control must agree with the target within a tolerance.
void check_tolerance(
  pluginlib::ClassLoader<KinematicsBase> & loader, const Loaded & loaded, const Row & row,
  Result & result)
{
  if (std::all_of(controls, controls + 6, [](bool one) {return one;})) {return;}
  const Numbers q(row.joints.begin(), row.joints.end());
  const Pose pose = forward(*loaded.robot, q, result);
  Pose other = pose;
  if (!controls[0]) {other.position.x += 0.1 * @length@;}
  if (!controls[1]) {other.position.y += 0.1 * @length@;}
  if (!controls[2]) {other.position.z += 0.1 * @length@;}
  if (controls[0] && controls[1] && controls[2]) {turn_uncontrolled(other);}
  Numbers found;
  MoveItErrorCodes code;
  result.check(
    !loaded.robot->getPositionIK(other, q, found, code) &&
    code.val == MoveItErrorCodes::NO_IK_SOLUTION, "a target beyond the tolerance");
  kinematics::KinematicsQueryOptions approximate;
  approximate.return_approximate_solution = true;
  result.check(
    loaded.robot->getPositionIK(other, q, found, code, approximate) && distance(found, q) <= limit,
    "an approximate solution");
  rclcpp::NodeOptions options;
  const std::string prefix = "robot_description_kinematics." + group + ".";
  options.append_parameter_override(prefix + "orientation_tolerance", 4.0);
  options.append_parameter_override(prefix + "position_tolerance", 1e6);
  options.automatically_declare_parameters_from_overrides(true);
  const Loaded tolerant = load(loader, describe(@robot@::Solver()), options);
  result.check(
    tolerant.initialized && tolerant.robot->getPositionIK(other, q, found, code),
    "tolerances are parameters");
}

int main(int count, char ** words)
{
  rclcpp::init(0, nullptr);
  const std::string table = count > 1 ? words[1] :
    ament_index_cpp::get_package_share_directory("@package@") + "/configurations.csv";
  const std::vector<Row> rows = read_rows(table);
  Result result;
  result.check(!rows.empty(), table + " has no rows");
  pluginlib::ClassLoader<KinematicsBase> loader("moveit_core", "kinematics::KinematicsBase");
  if (!rows.empty()) {
    const std::string urdf = describe(@robot@::Solver());
    const Loaded loaded = load(loader, urdf);
    result.check(
      loaded.robot->getTipFrame() == tip && loaded.robot->getBaseFrame() == base, "frames");
    compare_with_python(*loaded.robot, rows, result);
    check_unreachable(*loaded.robot, rows.front(), result);
    check_group(loader, urdf, result);
    if (count > 2) {
      std::ifstream file(words[2]);
      check_group(loader, {std::istreambuf_iterator<char>(file), {}}, result);
    }
    check_search(*loaded.robot, rows.front(), result);
    check_limits(loader, rows.front(), result);
    check_tolerance(loader, loaded, rows.front(), result);
    result.check(
      !load(loader, urdf, rclcpp::NodeOptions(), @robot@::c::@robot@_joint_names[0]).initialized,
      "a group without a driven joint");
  }
  std::printf("failed %d\n", result.failed);
  rclcpp::shutdown();
  return result.failed > 0;
}
