// @origin@
// A thin class around the functions of @name@.h. Nothing is allocated, nothing is thrown.
#pragma once

#include <cmath>

#include "@name@.h"

namespace @name@ {

using Real = @name@_real;
using Beginning = @name@_beginning;
using State = @name@_state;
using Measurement = @name@_measurement;
using Target = @name@_target;
using Command = @name@_command;

constexpr int sensors = @sensors@;
constexpr int sections = @sections@;
constexpr int coordinates = @coordinates@;
constexpr int tendons = @tendons_count@;

// A measurement in which every sensor counts and nothing else is known.
inline Measurement all_sensors() noexcept {
    Measurement measurement{};
    for (int k = 0; k < sensors; ++k) measurement.mask[k] = measurement.angular_mask[k] = true;
// @if tendons@
    for (Real& y : measurement.tendons) y = static_cast<Real>(NAN);
// @end@
// @if feedforward@
    for (Real& u : measurement.forces) u = static_cast<Real>(NAN);
// @end@
    return measurement;
}

// A straight arm with the first estimates of its rest lengths.
inline Beginning straight(double time) noexcept {
    Beginning beginning{};
    for (int i = 0; i < sections; ++i) beginning.pi_hat[i] = @name@_first_estimate[i];
    beginning.time = time;
    return beginning;
}

class Controller {
   public:
    // `time`: s, at or before the first measurement.
    explicit Controller(double time = 0.0) noexcept : Controller(straight(time)) {}
    explicit Controller(const Beginning& beginning) noexcept {
        @name@_start(&beginning, &state_);
        before_ = state_;
    }

    // One step. Call it with every measurement, in the order of their stamps.
    const Command& step(const Measurement& measurement, const Target& target) noexcept {
        before_ = state_;
        @name@_step(&state_, &measurement, &target, &command_);
        return command_;
    }

    // Finds the shape of an arm at rest, whose first guess is straight, before it is asked to move: steps on one
    // measurement with the end effector as its own target. Afterwards begins at `time` with the first estimates.
    void warm_up(Measurement measurement, int steps, double period, double time) noexcept {
        Target target{};
        for (int i = 0; i < 3; ++i) target.x_d[i] = measurement.T[sensors - 1][i][3];
        for (int k = 0; k < steps; ++k) {
            measurement.time = time - (steps - k) * period;
            step(measurement, target);
        }
        @name@_restart(&state_, time);
        before_ = state_;
    }

// @if covariance@
    // How sure the estimate of the last step is. `measurement`: Of that step.
    @name@_uncertainty uncertainty(const Measurement& measurement) const noexcept {
        @name@_uncertainty found;
        @name@_covariance(&before_, &state_, &measurement, &found);
        return found;
    }

// @end@
    const State& state() const noexcept { return state_; }
    const Command& command() const noexcept { return command_; }

   private:
    State state_{};
    State before_{};
    Command command_{};
};

}  // namespace @name@
