// kinematics_interface plug-in of @robot@. Written by parallel_cal @version@.
//
// The numbers are those of the calibrated model of sha256 @hash@; the robot description is not
// read. Conditions of the model (payload, temperature, direction of motion) are neutral.
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "@package@/@robot@.hpp"

#include "kinematics_interface/kinematics_interface.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/logging.hpp"
#include "rclcpp/parameter.hpp"

namespace @package@
{

using @robot@::Status;
using Parameters = std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface>;

const char base[] = "@base@";  // {B}
const char tip[] = "@tip@";  // {P}
constexpr Eigen::Index n_joints = @robot@::n_joints;

rclcpp::Logger logger()
{
  return rclcpp::get_logger("@package@");
}

class Kinematics : public kinematics_interface::KinematicsInterface
{
public:
  using KinematicsInterface::calculate_jacobian;
  using KinematicsInterface::calculate_jacobian_inverse;
  using KinematicsInterface::calculate_link_transform;
  using KinematicsInterface::convert_cartesian_deltas_to_joint_deltas;
  using KinematicsInterface::convert_joint_deltas_to_cartesian_deltas;

  bool initialize(
    const std::string & /*robot_description*/, Parameters parameters,
    const std::string & param_namespace) override
  {
    const std::string prefix = param_namespace.empty() ? "" : param_namespace + ".";
    initialized_ = has_link(parameters, prefix + "base", base) &&
      has_link(parameters, prefix + "tip", tip) && has_joints(parameters);
    return initialized_;
  }

  bool convert_cartesian_deltas_to_joint_deltas(
    const Eigen::VectorXd & joint_pos, const Eigen::Matrix<double, 6, 1> & delta_x,
    const std::string & link_name, Eigen::VectorXd & delta_theta) override
  {
    if (!has_size("delta_theta", delta_theta.size(), n_joints)) {return false;}
    if (!solve_at_tip(joint_pos, link_name)) {return false;}
    @robot@::InverseJacobian inverse{};
    if (!is_regular(@robot@::c::@robot@_inverse_jacobian(&found_, nullptr, inverse.data()))) {return false;}
    delta_theta = Eigen::Map<const InverseRows>(inverse.data()) * delta_x;
    return true;
  }

  bool convert_joint_deltas_to_cartesian_deltas(
    const Eigen::VectorXd & joint_pos, const Eigen::VectorXd & delta_theta,
    const std::string & link_name, Eigen::Matrix<double, 6, 1> & delta_x) override
  {
    if (!has_size("delta_theta", delta_theta.size(), n_joints)) {return false;}
    Rows rows;
    if (!calculate_rows(joint_pos, link_name, rows)) {return false;}
    delta_x = rows * delta_theta;
    return true;
  }

  bool calculate_link_transform(
    const Eigen::VectorXd & joint_pos, const std::string & link_name,
    Eigen::Isometry3d & transform) override
  {
    if (!is_usable(joint_pos, link_name)) {return false;}
    if (link_name == base) {
      transform.setIdentity();
      return true;
    }
    if (!solve(joint_pos)) {return false;}
    transform.setIdentity();
    transform.translation() = Eigen::Map<const Eigen::Vector3d>(found_.position);
    transform.linear() = Eigen::Map<const Rotation>(found_.rotation);
    return true;
  }

  bool calculate_jacobian(
    const Eigen::VectorXd & joint_pos, const std::string & link_name,
    Eigen::Matrix<double, 6, Eigen::Dynamic> & jacobian) override
  {
    if (!has_size("the Jacobian", jacobian.cols(), n_joints)) {return false;}
    Rows rows;
    if (!calculate_rows(joint_pos, link_name, rows)) {return false;}
    jacobian = rows;
    return true;
  }

  bool calculate_jacobian_inverse(
    const Eigen::VectorXd & joint_pos, const std::string & link_name,
    Eigen::Matrix<double, Eigen::Dynamic, 6> & jacobian_inverse) override
  {
    if (!has_size("the inverse Jacobian", jacobian_inverse.rows(), n_joints)) {return false;}
    if (!solve_at_tip(joint_pos, link_name)) {return false;}
    @robot@::InverseJacobian inverse{};
    if (!is_regular(@robot@::c::@robot@_inverse_jacobian(&found_, nullptr, inverse.data()))) {return false;}
    jacobian_inverse = Eigen::Map<const InverseRows>(inverse.data());
    return true;
  }

private:
  using Rows = Eigen::Matrix<double, 6, n_joints, n_joints == 1 ? Eigen::ColMajor : Eigen::RowMajor>;
  using InverseRows = Eigen::Matrix<double, n_joints, 6, Eigen::RowMajor>;
  using Rotation = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

  // A parameter that names a link may be missing, but must not name another link.
  static bool has_link(
    const Parameters & parameters, const std::string & name, const std::string & expected)
  {
    rclcpp::Parameter found;
    if (!parameters || !parameters->get_parameter(name, found)) {return true;}
    if (
      found.get_type() == rclcpp::ParameterType::PARAMETER_STRING && found.as_string() == expected)
    {
      return true;
    }
    RCLCPP_ERROR(
      logger(), "parameter %s is '%s', but the calibrated model has '%s': change it, or export the "
      "model with the names of your links", name.c_str(), found.value_to_string().c_str(),
      expected.c_str());
    return false;
  }

  // The interface passes positions without names: a controller that lists its joints in another
  // order would get wrong answers.
  static bool has_joints(const Parameters & parameters)
  {
    rclcpp::Parameter found;
    if (!parameters || !parameters->get_parameter("joints", found)) {return true;}
    std::vector<std::string> expected;
    for (const char * name : @robot@::c::@robot@_joint_names) {expected.emplace_back(name);}
    const rclcpp::Parameter model("joints", expected);
    if (found == model) {return true;}
    RCLCPP_ERROR(
      logger(), "parameter joints is %s, expected the joints of the calibrated model in their order: "
      "%s", found.value_to_string().c_str(), model.value_to_string().c_str());
    return false;
  }

  static bool has_size(const char * what, Eigen::Index size, Eigen::Index expected)
  {
    if (size == expected) {return true;}
    RCLCPP_ERROR(
      logger(), "%s has size %ld, expected %ld, one for each joint", what,
      static_cast<long>(size), static_cast<long>(expected));
    return false;
  }

  static bool is_regular(int status)
  {
    if (status == 0) {return true;}
    RCLCPP_ERROR(logger(), "the robot is singular at these joints");
    return false;
  }

  bool is_usable(const Eigen::VectorXd & joint_pos, const std::string & link_name) const
  {
    if (!initialized_) {
      RCLCPP_ERROR(logger(), "initialize() has not been called, or it failed");
      return false;
    }
    if (link_name != base && link_name != tip) {
      RCLCPP_ERROR(
        logger(), "link '%s' is unknown, expected '%s' or '%s'", link_name.c_str(), tip, base);
      return false;
    }
    return has_size("joint_pos", joint_pos.size(), n_joints);
  }

  // On the branch of home: the answer does not depend on earlier calls.
  bool solve(const Eigen::VectorXd & joint_pos)
  {
    const Status status{
      @robot@::c::@robot@_direct(joint_pos.data(), nullptr, nullptr, &found_, nullptr)};
    if (status == Status::converged || status == Status::outside_limits) {return true;}
    RCLCPP_ERROR(
      logger(), "the pose for these joints was not found: status %d of @robot@.hpp",
      static_cast<int>(status));
    return false;
  }

  bool solve_at_tip(const Eigen::VectorXd & joint_pos, const std::string & link_name)
  {
    if (!is_usable(joint_pos, link_name)) {return false;}
    if (link_name == tip) {return solve(joint_pos);}
    RCLCPP_ERROR(logger(), "link '%s' does not move, expected '%s'", link_name.c_str(), tip);
    return false;
  }

  bool calculate_rows(const Eigen::VectorXd & joint_pos, const std::string & link_name, Rows & rows)
  {
    if (!is_usable(joint_pos, link_name)) {return false;}
    if (link_name == base) {
      rows.setZero();
      return true;
    }
    @robot@::Jacobian jacobian{};
    if (!solve(joint_pos) || !is_regular(@robot@::c::@robot@_jacobian(&found_, nullptr, jacobian.data()))) {return false;}
    rows = Eigen::Map<const Rows>(jacobian.data());
    return true;
  }

  @robot@::Configuration found_{};
  bool initialized_ = false;
};

}  // namespace @package@

PLUGINLIB_EXPORT_CLASS(@package@::Kinematics, kinematics_interface::KinematicsInterface)
