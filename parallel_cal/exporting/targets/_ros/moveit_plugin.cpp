// MoveIt kinematics plug-in of @robot@. Written by parallel_cal @version@.
//
// The numbers are those of the calibrated model of sha256 @hash@; the robot description gives the
// names of links and the limits of joints alone. Conditions of the model (payload, temperature,
// direction of motion) are neutral.
#include <algorithm>
#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include "@package@/@robot@_solver.hpp"

#include "moveit/kinematics_base/kinematics_base.hpp"
#include "moveit/robot_model/joint_model_group.hpp"
#include "moveit/robot_model/robot_model.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/logging.hpp"
#include "rclcpp/node.hpp"

namespace @package@
{

using geometry_msgs::msg::Pose;
using kinematics::KinematicsQueryOptions;
using moveit_msgs::msg::MoveItErrorCodes;
using @robot@::Joints;
using @robot@::Status;
using Numbers = std::vector<double>;

const char base[] = "@base@";  // {B}
const char tip[] = "@tip@";  // {P}
constexpr double unit_length = 1e-3;  // by which the length of a quaternion may differ from 1

rclcpp::Logger logger()
{
  return rclcpp::get_logger("@package@");
}

std::string list(const std::vector<std::string> & names)
{
  std::string text;
  for (const std::string & name : names) {text += (text.empty() ? "" : ", ") + name;}
  return text;
}

// False where the pose is not finite, or the quaternion has not unit length.
bool convert(const Pose & pose, @robot@::Vector3 & position, @robot@::Rotation & rotation)
{
  double x = pose.orientation.x, y = pose.orientation.y, z = pose.orientation.z;
  double w = pose.orientation.w;
  const double length = std::sqrt(x * x + y * y + z * z + w * w);
  position = {pose.position.x, pose.position.y, pose.position.z};
  for (double value : position) {if (!std::isfinite(value)) {return false;}}
  if (!(std::fabs(length - 1) <= unit_length)) {return false;}
  x /= length, y /= length, z /= length, w /= length;
  rotation = {
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)};
  return true;
}

Pose convert(const @robot@::Configuration & at)
{
  const double * R = at.rotation;
  // The largest of four forms of the quaternion, which are equal up to a factor.
  const double forms[4][4] = {
    {R[7] - R[5], R[2] - R[6], R[3] - R[1], 1 + R[0] + R[4] + R[8]},
    {1 + R[0] - R[4] - R[8], R[1] + R[3], R[2] + R[6], R[7] - R[5]},
    {R[1] + R[3], 1 - R[0] + R[4] - R[8], R[5] + R[7], R[2] - R[6]},
    {R[2] + R[6], R[5] + R[7], 1 - R[0] - R[4] + R[8], R[3] - R[1]}};
  const double diagonal[4] = {forms[0][3], forms[1][0], forms[2][1], forms[3][2]};
  const double * q = forms[std::max_element(diagonal, diagonal + 4) - diagonal];
  const double length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  Pose pose;
  pose.position.x = at.position[0], pose.position.y = at.position[1];
  pose.position.z = at.position[2];
  pose.orientation.x = q[0] / length, pose.orientation.y = q[1] / length;
  pose.orientation.z = q[2] / length, pose.orientation.w = q[3] / length;
  return pose;
}

class Kinematics : public kinematics::KinematicsBase
{
public:
  using KinematicsBase::getPositionIK;
  using KinematicsBase::searchPositionIK;

  Kinematics()
  {
    for (const char * name : @robot@::c::@robot@_joint_names) {joint_names_.emplace_back(name);}
  }

  // The frames are those of the model, not those that MoveIt derives from the order of the group's
  // links: it reads them by getBaseFrame() and getTipFrames().
  bool initialize(
    const rclcpp::Node::SharedPtr & node, const moveit::core::RobotModel & robot_model,
    const std::string & group_name, const std::string & /*base_frame*/,
    const std::vector<std::string> & /*tip_frames*/, double search_discretization) override
  {
    node_ = node;
    storeValues(robot_model, group_name, base, {tip}, search_discretization);
    for (const char * link : {base, tip}) {
      if (robot_model.hasLinkModel(link)) {continue;}
      RCLCPP_ERROR(
        logger(), "link '%s' of the calibrated model is not in the robot description: rename the "
        "link there, or export the model with the names of your links", link);
      return false;
    }
    const moveit::core::JointModelGroup * group = robot_model.getJointModelGroup(group_name);
    std::string reason = "the SRDF has no such group, or it is empty";
    if (!group || !supportsGroup(group, &reason)) {
      RCLCPP_ERROR(logger(), "group '%s': %s", group_name.c_str(), reason.c_str());
      return false;
    }
    take_limits(robot_model);
    initialized_ =
      read_tolerance("position_tolerance", solver_.position_tolerance) &&
      read_tolerance("orientation_tolerance", solver_.orientation_tolerance);
    return initialized_;
  }

  // A group of the driven joints, in any order: that of a parallel robot is no chain.
  bool supportsGroup(
    const moveit::core::JointModelGroup * group, std::string * error_text_out) const override
  {
    std::vector<std::string> found = group->getVariableNames(), expected = joint_names_;
    std::sort(found.begin(), found.end());
    std::sort(expected.begin(), expected.end());
    if (found == expected) {return true;}
    if (error_text_out) {
      *error_text_out = "it moves " + list(group->getVariableNames()) +
        ", expected exactly the joints of the calibrated model: " + list(joint_names_);
    }
    return false;
  }

  bool getPositionIK(
    const Pose & ik_pose, const Numbers & ik_seed_state, Numbers & solution,
    MoveItErrorCodes & error_code, const KinematicsQueryOptions & options) const override
  {
    @robot@::Vector3 position{};
    @robot@::Rotation rotation{};
    Joints seed{}, joints{};
    error_code.val = MoveItErrorCodes::NO_IK_SOLUTION;
    if (!is_usable(ik_seed_state, seed) || !convert(ik_pose, position, rotation)) {return false;}
    const Status status =
      solver_.inverse(position, rotation, seed, options.return_approximate_solution, joints);
    if (status != Status::converged) {return false;}
    solution.assign(joints.begin(), joints.end());
    error_code.val = MoveItErrorCodes::SUCCESS;
    return true;
  }

  bool searchPositionIK(
    const Pose & ik_pose, const Numbers & ik_seed_state, double timeout, Numbers & solution,
    MoveItErrorCodes & error_code, const KinematicsQueryOptions & options) const override
  {
    return searchPositionIK(
      ik_pose, ik_seed_state, timeout, {}, solution, IKCallbackFn(), error_code, options);
  }

  bool searchPositionIK(
    const Pose & ik_pose, const Numbers & ik_seed_state, double timeout,
    const Numbers & consistency_limits, Numbers & solution, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options) const override
  {
    return searchPositionIK(
      ik_pose, ik_seed_state, timeout, consistency_limits, solution, IKCallbackFn(), error_code,
      options);
  }

  bool searchPositionIK(
    const Pose & ik_pose, const Numbers & ik_seed_state, double timeout, Numbers & solution,
    const IKCallbackFn & solution_callback, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options) const override
  {
    return searchPositionIK(
      ik_pose, ik_seed_state, timeout, {}, solution, solution_callback, error_code, options);
  }

  bool searchPositionIK(
    const Pose & ik_pose, const Numbers & ik_seed_state, double timeout,
    const Numbers & consistency_limits, Numbers & solution, const IKCallbackFn & solution_callback,
    MoveItErrorCodes & error_code, const KinematicsQueryOptions & options) const override
  {
    @robot@::Vector3 position{};
    @robot@::Rotation rotation{};
    Joints seed{}, joints{};
    error_code.val = MoveItErrorCodes::NO_IK_SOLUTION;
    if (!is_usable(ik_seed_state, seed) || !convert(ik_pose, position, rotation)) {return false;}
    if (!consistency_limits.empty() && !has_size("consistency_limits", consistency_limits.size())) {
      return false;
    }
    const auto accept = [&](const Joints & found) {
        error_code.val = MoveItErrorCodes::SUCCESS;
        if (solution_callback) {
          solution_callback(ik_pose, Numbers(found.begin(), found.end()), error_code);
        }
        return error_code.val == MoveItErrorCodes::SUCCESS;
      };
    const Status status = solver_.search(
      position, rotation, seed, consistency_limits.empty() ? nullptr : consistency_limits.data(),
      timeout, options.return_approximate_solution, joints, accept);
    if (status == Status::converged) {
      solution.assign(joints.begin(), joints.end());
      return true;
    }
    error_code.val = MoveItErrorCodes::TIMED_OUT;
    return false;
  }

  bool getPositionFK(
    const std::vector<std::string> & link_names, const Numbers & joint_angles,
    std::vector<Pose> & poses) const override
  {
    Joints joints{};
    @robot@::Configuration found{};
    if (!is_usable(joint_angles, joints)) {return false;}
    poses.clear();
    for (const std::string & link : link_names) {
      Pose pose;
      if (link != base && link != tip) {
        RCLCPP_ERROR(
          logger(), "link '%s' is unknown, expected '%s' or '%s'", link.c_str(), tip, base);
        return false;
      }
      if (link == tip) {
        if (!solver_.forward(joints, found)) {return false;}
        pose = convert(found);
      }
      poses.push_back(pose);
    }
    return true;
  }

  const std::vector<std::string> & getJointNames() const override {return joint_names_;}
  const std::vector<std::string> & getLinkNames() const override {return tip_frames_;}

private:
  static bool has_size(const char * what, std::size_t size)
  {
    if (size == @robot@::n_joints) {return true;}
    RCLCPP_ERROR(
      logger(), "%s has size %zu, expected %d, one for each joint", what, size, @robot@::n_joints);
    return false;
  }

  bool is_usable(const Numbers & state, Joints & joints) const
  {
    if (!initialized_) {
      RCLCPP_ERROR(logger(), "initialize() has not been called, or it failed");
      return false;
    }
    if (!has_size("the joint state", state.size())) {return false;}
    std::copy(state.begin(), state.end(), joints.begin());
    return std::all_of(state.begin(), state.end(), [](double q) {return std::isfinite(q);});
  }

  void take_limits(const moveit::core::RobotModel & robot_model)
  {
    for (std::size_t i = 0; i < joint_names_.size(); ++i) {
      const moveit::core::VariableBounds & bounds = robot_model.getVariableBounds(joint_names_[i]);
      if (!bounds.position_bounded_) {continue;}
      solver_.low[i] = std::max(solver_.low[i], bounds.min_position_);
      solver_.high[i] = std::min(solver_.high[i], bounds.max_position_);
    }
  }

  // Read from kinematics.yaml, beside kinematics_solver of the group.
  bool read_tolerance(const std::string & name, double & value) const
  {
    const std::string full = "robot_description_kinematics." + group_name_ + "." + name;
    try {
      if (!node_->has_parameter(full)) {node_->declare_parameter<double>(full, value);}
      value = node_->get_parameter(full).as_double();
    } catch (const std::exception & error) {
      RCLCPP_ERROR(logger(), "parameter %s: %s", full.c_str(), error.what());
      return false;
    }
    if (value >= 0) {return true;}
    RCLCPP_ERROR(logger(), "parameter %s is %g, expected 0 or more", full.c_str(), value);
    return false;
  }

  @robot@::Solver solver_;
  std::vector<std::string> joint_names_;
  bool initialized_ = false;
};

}  // namespace @package@

PLUGINLIB_EXPORT_CLASS(@package@::Kinematics, kinematics::KinematicsBase)
