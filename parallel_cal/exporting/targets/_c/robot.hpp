// @robot@: direct and inverse problem of @what@, for C++17.
//
// Written by parallel_cal @version@ from a model of sha256 @hash@.
// Units: m, rad, s, kg, degC. No allocation, no exception, no global state. A Robot keeps what a
// controller must remember from cycle to cycle; use one per thread. The C functions are in
// @robot@::c. Define @ROBOT@_WITH_EIGEN before the inclusion for views of Eigen.
//
@joint_table_cpp@
#ifndef @ROBOT@_HPP
#define @ROBOT@_HPP

#include <math.h>
#include <string.h>

#include <array>

#ifdef @ROBOT@_WITH_EIGEN
#include <Eigen/Core>
#endif

namespace @robot@ {
namespace c {
@embedded@
} // namespace c

inline constexpr int n_joints = @n_joints@; // @joints@
using Joints = std::array<double, n_joints>;
using Vector3 = std::array<double, 3>;
using Rotation = std::array<double, 9>;               // row by row
using Jacobian = std::array<double, 6 * n_joints>;    // 6 x n_joints row by row
using InverseJacobian = std::array<double, n_joints * 6>;
using Conditions = c::@robot@_conditions;
using Configuration = c::@robot@_configuration;

enum class Status : int {
    converged = 0,
    unreachable = 1,
    singular = 2,
    outside_limits = 3,
    not_converged = 4,
    invalid_input = 5,
    effort_exceeded = 7,
    other_branch = 8
};

// The state of one controller: the last pose and command, the motion of the joints, the conditions.
// It is complete from its construction on; it owns nothing that must be released.
class Robot {
public:
    Conditions conditions = @ROBOT@_NEUTRAL;
    int max_steps = c::ALL_STEPS; // of the careful method in one call: bounds its time

    Robot() noexcept { c::@robot@_motion_begin(&motion_, c::@robot@_home.joints); }

    // Begin at a reading: its direction and travel are unknown, and the pose is on the branch of home.
    // A pose from before may be far away, and lead to a mirrored one.
    [[nodiscard]] Status begin(const Joints &reading) noexcept
    {
        const int bad = c::@robot@_motion_begin(&motion_, reading.data());
        return bad ? Status{bad} : solve_pose(reading, nullptr);
    }

    // Take the reading of a cycle, `period` s after the last: updates the conditions by joint and the
    // pose. After any status but converged and outside_limits, the pose before stays. Where readings
    // jump so far that the pose may be on another branch than the last, it is on that of home.
    [[nodiscard]] Status update(const Joints &reading, double period) noexcept
    {
        const int bad = c::@robot@_motion_follow(&motion_, reading.data(), period);
        if (bad) return Status{bad};
        c::@robot@_motion_conditions(&motion_, &conditions);
        return solve_pose(reading, &pose_);
    }

    // Joints for a pose, on the branch of the last command, or on the home branch if only there they
    // are inside their limits: they may then jump. They change only if it converged.
    [[nodiscard]] Status solve(const Vector3 &position, const Rotation &rotation,
        Joints &joints) noexcept
    {
        Configuration found = command_;
        const Status status{c::@robot@_inverse_capped(position.data(), rotation.data(), &conditions,
            &command_, max_steps, &found, nullptr)};
        if (status != Status::converged) return status;
        command_ = found;
        memcpy(joints.data(), found.joints, sizeof found.joints);
        return status;
    }

    [[nodiscard]] const Configuration &pose() const noexcept { return pose_; }
    [[nodiscard]] const Configuration &command() const noexcept { return command_; }
    [[nodiscard]] const c::@robot@_motion &motion() const noexcept { return motion_; }

    // At the pose of a configuration; Status::singular where there is none.
    [[nodiscard]] Status jacobian(const Configuration &at, Jacobian &to) const noexcept
    {
        return Status{c::@robot@_jacobian(&at, &conditions, to.data())};
    }
    [[nodiscard]] Status inverse_jacobian(const Configuration &at, InverseJacobian &to) const noexcept
    {
        return Status{c::@robot@_inverse_jacobian(&at, &conditions, to.data())};
    }
    [[nodiscard]] Status jacobian_rate(const Configuration &at, const Joints &velocity,
        Jacobian &to) const noexcept
    {
        return Status{c::@robot@_jacobian_rate(&at, &conditions, velocity.data(), to.data())};
    }

private:
    [[nodiscard]] Status solve_pose(const Joints &reading, const Configuration *start) noexcept
    {
        Configuration found = pose_;
        const Status status{c::@robot@_direct_capped(
            reading.data(), &conditions, start, max_steps, &found, nullptr)};
        if (status != Status::converged && status != Status::outside_limits) return status;
        if (start && !is_short_step(*start, found)) return solve_pose(reading, nullptr);
        pose_ = found;
        return status;
    }

    [[nodiscard]] static bool is_short_step(const Configuration &here,
        const Configuration &there) noexcept
    {
        double from[c::NX], to[c::NX];
        c::row_of(&here, from);
        c::row_of(&there, to);
        memcpy(from, to, sizeof there.joints); // the joints are given
        return c::short_step(from, to) != 0;
    }

    Configuration pose_ = c::@robot@_home, command_ = c::@robot@_home;
    c::@robot@_motion motion_{};
};

#ifdef @ROBOT@_WITH_EIGEN
// Views of the arrays above, without a copy.
template <int rows, int columns>
using View = Eigen::Map<const Eigen::Matrix<double, rows, columns,
    columns == 1 ? Eigen::ColMajor : Eigen::RowMajor>>;
inline View<6, n_joints> view(const Jacobian &of) noexcept { return View<6, n_joints>(of.data()); }
inline View<n_joints, 1> joints(const Configuration &of) noexcept
{
    return View<n_joints, 1>(of.joints);
}
inline View<3, 1> position(const Configuration &of) noexcept { return View<3, 1>(of.position); }
inline View<3, 3> rotation(const Configuration &of) noexcept { return View<3, 3>(of.rotation); }
#endif

} // namespace @robot@
#endif
