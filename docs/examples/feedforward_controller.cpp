// A controller in the style of ros2_control with an exported model as feedforward: no network, allocation or waiting.
//
//     lipserve models export panda-sim . --format c
//     cc -O2 -c lipserve_model.c
//     c++ -std=c++17 -O2 feedforward_controller.cpp lipserve_model.o -o controller
//     ./controller 5000 0 0 0 -1.8 0 1.6 0     number of cycles, and the posture to move around (default: zero)
//
// In ROS 2, derive the class from controller_interface::ControllerInterface: it has methods named on_configure and
// update, and interfaces for references and commands. Nothing here protects your hardware from a wrong torque: keep the
// limits and the emergency stop of your controller.

#include "lipserve_model.h"

#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>

using Joints = std::array<double, LIPSERVE_JOINTS>;

struct Measured {
    Joints q, dq;
};

struct Reference {
    Joints q, dq, ddq;
};

class FeedforwardController {
public:
    // Call before the loop. Returns whether this machine computes the same as the service, for these joints in order.
    bool on_configure(const std::vector<std::string> &joints)
    {
        if (const int vector = lipserve_selftest()) {
            std::fprintf(stderr, "vector %d of the model's self-test differs. Check the compiler and its options.\n", vector);
            return false;
        }
        if (joints.size() != LIPSERVE_JOINTS)
            return false;
        for (std::size_t j = 0; j < joints.size(); j++)
            if (joints[j] != lipserve_joint_names[j])
                return false;
        lipserve_start(&state_);
        return true;
    }

    // Sets the payload from the next cycle on; nullptr: none. Call it from the loop's thread.
    void set_payload(const lipserve_payload *payload)
    {
        has_payload_ = payload != nullptr;
        if (has_payload_)
            payload_ = *payload;
    }

    // One cycle. Sets the model's torque if the motion is in the training range and the torque certain enough, else
    // zero, so that only the feedback acts. Returns whether the torque is used. dt: time since the last cycle, s.
    bool update(const Measured &measured, const Reference &reference, double dt, Joints &effort)
    {
        Joints tau_std;
        lipserve_update(&state_, measured.q.data(), measured.dq.data(), dt);
        lipserve_torque_state(reference.q.data(), reference.dq.data(), reference.ddq.data(),
                              has_payload_ ? &payload_ : nullptr, &state_, effort.data(), tau_std.data());
        bool certain = lipserve_in_range(reference.q.data(), reference.dq.data(), reference.ddq.data()) != 0;
        for (const double each : tau_std)
            certain = certain && each < max_std_; // false for NaN
        if (!certain)
            effort.fill(0.0);
        return certain;
    }

private:
    double max_std_ = 1.0; // N m; choose it joint by joint for your robot
    bool has_payload_ = false;
    lipserve_payload payload_ = {};
    lipserve_state state_ = {}; // friction remembers where each joint came from
};

// An example trajectory: sinusoids around a posture.
static Reference desired(const Joints &middle, double t)
{
    Reference out;
    for (std::size_t j = 0; j < LIPSERVE_JOINTS; j++) {
        const double w = 0.5 + 0.1 * static_cast<double>(j);
        out.q[j] = middle[j] + 0.2 * std::sin(w * t);
        out.dq[j] = 0.2 * w * std::cos(w * t);
        out.ddq[j] = -0.2 * w * w * std::sin(w * t);
    }
    return out;
}

int main(int count, char **arguments)
{
    using namespace std::chrono;
    const long cycles = count > 1 ? std::atol(arguments[1]) : 5000;
    Joints middle = {}, effort;
    for (int j = 0; j + 2 < count && j < LIPSERVE_JOINTS; j++)
        middle[static_cast<std::size_t>(j)] = std::atof(arguments[j + 2]);
    FeedforwardController controller;
    if (!controller.on_configure({std::begin(lipserve_joint_names), std::end(lipserve_joint_names)}))
        return 1;
    const lipserve_payload held = {0.5, {0.0, 0.0, 0.1}, {}};
    long used = 0;
    double longest = 0.0;
    const auto start = steady_clock::now();
    for (long k = 0; k < cycles; k++) {
        std::this_thread::sleep_until(start + milliseconds(k)); // 1 kHz
        if (k == cycles / 2)
            controller.set_payload(&held);
        const auto before = steady_clock::now();
        const Reference reference = desired(middle, 1e-3 * static_cast<double>(k));
        const Measured measured = {reference.q, reference.dq}; // read the joints' sensors here
        used += controller.update(measured, reference, 1e-3, effort);
        longest = std::fmax(longest, duration<double, std::micro>(steady_clock::now() - before).count());
        // send the effort to the drives here, added to the feedback
    }
    std::printf("used %ld of %ld, the longest cycle took %.1f us\n", used, cycles, longest);
    if (used == 0)
        std::puts("No torque was used. Choose a posture within the training range in lipserve_model.h.");
    return 0;
}
