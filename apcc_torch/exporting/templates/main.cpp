// @origin@
// A loop to begin from: read the sensors, step, send the command.
#include <cstdio>

#include "@name@.hpp"
// @if not plant@
#include "../test/vectors.hpp"
// @end@

int main() {
    const double period = @period@;  // s
// @if plant@
    // The true arm of a simulation stands for yours.
    @name@_plant arm;
    @name@_plant_start(&arm);
    @name@_reference reference{};
// @end@
// @if plant_of_chambers@
    for (int a = 0; a < @name@::tendons; ++a) reference.pressure[a] = arm.held[a];
// @end@
// @if plant@
    @name@_view view;
    @name@_plant_step(&arm, &reference, &view);

// @end@
    @name@::Measurement measurement = @name@::all_sensors();
// @if plant@
    for (int k = 0; k < @name@::sensors; ++k)
        for (int i = 0; i < 16; ++i) measurement.T[k][i / 4][i % 4] = view.T[k][i / 4][i % 4];
// @end@
// @if not plant@
    // Poses that were prepared stand for your sensors, and do not follow the command.
    measurement = measurements[0];
// @end@

    @name@::Controller controller;
    controller.warm_up(measurement, 100, period, 0.0);

    // Here the target is 3 cm from where the tip is.
    @name@::Target target{};
    for (int i = 0; i < 3; ++i) target.x_d[i] = measurement.T[@name@::sensors - 1][i][3];
    target.x_d[0] += static_cast<@name@::Real>(0.02);
    target.x_d[1] += static_cast<@name@::Real>(0.02);
    target.x_d[2] += static_cast<@name@::Real>(0.01);

    for (int k = 1; k <= 500; ++k) {
        measurement.time = k * period;
        const @name@::Command& command = controller.step(measurement, target);
        if (command.status == @NAME@_INVALID) {
            std::printf("step %d: no sensor to estimate from\n", k);
            return 1;
        }
// @if plant_of_chambers@
        for (int a = 0; a < @name@::tendons; ++a) reference.pressure[a] = command.pressure[a];
        for (int step = 0; step < @substeps@; ++step) @name@_plant_step(&arm, &reference, &view);
// @end@
// @if plant_of_tendons@
        for (int step = 0; step < @substeps@; ++step) {  // the motors run to the new lengths in one period
            for (int a = 0; a < @name@::tendons; ++a) {
                const double left = period - step * @plant_step@;
                reference.ydot_d[a] = static_cast<@name@::Real>((command.y[a] - reference.y_d[a]) / left);
            }
            for (int a = 0; a < @name@::tendons; ++a)
                reference.y_d[a] += static_cast<@name@::Real>(@plant_step@) * reference.ydot_d[a];
            @name@_plant_step(&arm, &reference, &view);
        }
// @end@
// @if plant@
        for (int s = 0; s < @name@::sensors; ++s)
            for (int i = 0; i < 16; ++i) measurement.T[s][i / 4][i % 4] = view.T[s][i / 4][i % 4];
// @end@
        if (k % 100 == 0) {
            std::printf("%5.2f s  error %7.3f %7.3f %7.3f mm  status %d  @told@", k * period,
                        1e3 * static_cast<double>(command.e[0]), 1e3 * static_cast<double>(command.e[1]),
                        1e3 * static_cast<double>(command.e[2]), static_cast<int>(command.status));
// @if not pressures@
            for (double y : command.y) std::printf(" %6.1f", 1e3 * y);
            std::printf(" mm\n");
// @end@
// @if pressures@
            for (double p : command.pressure) std::printf(" %6.1f", 1e-3 * p);
            std::printf(" kPa\n");
// @end@
        }
    }
    return 0;
}
