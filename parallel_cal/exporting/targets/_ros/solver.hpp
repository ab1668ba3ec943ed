// Inverse kinematics of @robot@ as MoveIt's KinematicsBase asks for it, without ROS.
//
// Written by parallel_cal @version@. All functions are const and keep nothing between calls: any
// number of threads may use one Solver.
#ifndef @ROBOT@_SOLVER_HPP
#define @ROBOT@_SOLVER_HPP

#include "@robot@.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <random>

namespace @robot@ {

class Solver {
public:
    // Limits of the readings: those of the model, or narrower ones of a robot description.
    Joints low{}, high{};
    // By how much the pose of the solution may differ from the target: in the coordinates that the
    // robot does not control, this is not zero.
    double position_tolerance = @position_tolerance@; // m
    double orientation_tolerance = @orientation_tolerance@; // rad

    Solver() noexcept
    {
        std::copy_n(c::@robot@_joint_low, n_joints, low.begin());
        std::copy_n(c::@robot@_joint_high, n_joints, high.begin());
    }

    // Pose for joints, on the branch of home. False if there is none.
    [[nodiscard]] bool forward(const Joints &joints, Configuration &to) const noexcept
    {
        return is_solved(c::@robot@_direct(joints.data(), nullptr, nullptr, &to, nullptr));
    }

    // Joints for a pose on the branch of the seed, or of home if the seed leads to no solution. They
    // change only if the status is converged: the robot is then within its limits, and `forward`
    // returns the target for these joints. `approximate` accepts any difference in the coordinates
    // that the robot does not control.
    [[nodiscard]] Status inverse(const Vector3 &position, const Rotation &rotation,
        const Joints &seed, bool approximate, Joints &to) const noexcept
    {
        Configuration start{};
        if (forward(seed, start)
            && inverse_from(&start, position, rotation, seed, approximate, to) == Status::converged)
            return Status::converged;
        return inverse_from(nullptr, position, rotation, seed, approximate, to);
    }

    // As above, and from random joints within the limits until `timeout` s have passed. `accept`
    // is asked about every solution. With `consistency`, no joint may be further from its seed.
    // The sequence of random joints is the same in every call.
    template <class Accept>
    [[nodiscard]] Status search(const Vector3 &position, const Rotation &rotation,
        const Joints &seed, const double *consistency, double timeout, bool approximate, Joints &to,
        Accept accept) const
    {
        using clock = std::chrono::steady_clock;
        const auto begin = clock::now();
        std::minstd_rand random{1};
        Joints from = seed, found{};
        do {
            const Status status = inverse(position, rotation, from, approximate, found);
            if (status == Status::invalid_input) return status;
            if (status == Status::converged && is_near(found, seed, consistency) && accept(found)) {
                to = found;
                return status;
            }
            for (std::size_t i = 0; i < n_joints; ++i) from[i] = draw(i, seed, consistency, random);
        } while (std::chrono::duration<double>(clock::now() - begin).count() < timeout);
        return Status::effort_exceeded;
    }

private:
    // Whether the configuration closes, be it beyond a limit or singular.
    static bool is_solved(int status) noexcept
    {
        return status == int(Status::converged) || status == int(Status::outside_limits)
            || status == int(Status::singular);
    }

    Status inverse_from(const Configuration *start, const Vector3 &position,
        const Rotation &rotation, const Joints &seed, bool approximate, Joints &to) const noexcept
    {
        Configuration found{}, reached{};
        const int status = c::@robot@_inverse(
            position.data(), rotation.data(), nullptr, start, &found, nullptr);
        if (!is_solved(status)) return Status{status};
        turn_towards(seed, found);
        Joints joints{};
        std::copy_n(found.joints, n_joints, joints.begin());
        if (!is_within_limits(joints)) return Status::outside_limits;
        if (!forward(joints, reached)) return Status::other_branch;
        if (!approximate && !agrees(reached, position, rotation)) return Status::unreachable;
        to = joints;
        return Status::converged;
    }

    bool is_within_limits(const Joints &joints) const noexcept
    {
        for (std::size_t i = 0; i < n_joints; ++i)
            if (!(low[i] <= joints[i] && joints[i] <= high[i])) return false;
        return true;
    }

    static bool is_near(const Joints &joints, const Joints &seed, const double *distance) noexcept
    {
        for (std::size_t i = 0; distance && i < n_joints; ++i)
            if (!(std::fabs(joints[i] - seed[i]) <= distance[i])) return false;
        return true;
    }

    bool agrees(const Configuration &reached, const Vector3 &position,
        const Rotation &rotation) const noexcept
    {
        double distance = 0, chord = 0; // |A - B| of rotation matrices is 2 sqrt 2 sin(angle / 2)
        for (std::size_t i = 0; i < 3; ++i)
            distance = std::hypot(distance, reached.position[i] - position[i]);
        for (std::size_t i = 0; i < 9; ++i)
            chord = std::hypot(chord, reached.rotation[i] - rotation[i]);
        const double angle = 2 * std::asin(std::min(1.0, chord / std::sqrt(8.0)));
        return distance <= position_tolerance && angle <= orientation_tolerance;
    }

    // Turn endless joints by whole turns: as near to the seed as the limits permit. Effects of the
    // model need not repeat with a turn, so a joint moves only if the pose stays.
    void turn_towards(const Joints &seed, Configuration &at) const noexcept
    {
        for (std::size_t i = 0; i < n_joints; ++i) {
            const double turn = c::TURN[i];
            if (!(turn > 0)) continue;
            double nearest = at.joints[i] + turn * std::rint((seed[i] - at.joints[i]) / turn);
            if (nearest < low[i]) nearest += turn * std::ceil((low[i] - nearest) / turn);
            if (nearest > high[i]) nearest -= turn * std::ceil((nearest - high[i]) / turn);
            Configuration turned = at, reached{};
            turned.joints[i] = nearest;
            if (is_solved(c::@robot@_direct(turned.joints, nullptr, &turned, &reached, nullptr))
                && is_same_pose(reached, at))
                at.joints[i] = nearest;
        }
    }

    static bool is_same_pose(const Configuration &a, const Configuration &b) noexcept
    {
        double squares = 0;
        for (std::size_t i = 0; i < 3; ++i) squares += c::square(a.position[i] - b.position[i]);
        for (std::size_t i = 0; i < 9; ++i) squares += c::square(a.rotation[i] - b.rotation[i]);
        return std::sqrt(squares) < 10 * c::CLOSED; // rounding of two solutions
    }

    // A reading within the limits, and within `distance` of the seed; an endless joint without
    // limits anywhere in a turn.
    double draw(std::size_t i, const Joints &seed, const double *distance,
        std::minstd_rand &random) const
    {
        const double half_turn = c::TURN[i] > 0 ? c::TURN[i] / 2 : HUGE_VAL;
        const double reach = distance ? std::min(distance[i], half_turn) : half_turn;
        const double from = std::max(low[i], seed[i] - reach);
        const double until = std::min(high[i], seed[i] + reach);
        if (!(from < until) || !std::isfinite(until - from)) return seed[i];
        return std::uniform_real_distribution<double>{from, until}(random);
    }
};

} // namespace @robot@
#endif
