// A controller as of ros2_control whose feedforward is an exported model: no network, no allocation, no wait.
//
//     lipserve models export panda-sim --c .
//     cc -O2 -c lipserve_model.c
//     c++ -std=c++17 -O2 feedforward_controller.cpp lipserve_model.o -o controller
//     ./controller 5000 0 0 0 -1.8 0 1.6 0     cycles, and the posture to move about, zero by default
//
// In ROS 2 the class derives from controller_interface::ControllerInterface: on_configure and update are its methods of
// these names, references and commands its interfaces. Nothing here stands between a wrong torque and your hardware:
// keep the limits and the emergency stop of your controller.

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

struct Reference {
    Joints q, dq, ddq;
};

class FeedforwardController {
public:
    // Before the loop runs: whether this machine computes what the service does, for these joints in this order.
    bool on_configure(const std::vector<std::string> &joints)
    {
        if (const int vector = lipserve_selftest()) {
            std::fprintf(stderr, "vector %d of the model's self-test differs: what compiled it?\n", vector);
            return false;
        }
        if (joints.size() != LIPSERVE_JOINTS)
            return false;
        for (std::size_t j = 0; j < joints.size(); j++)
            if (joints[j] != lipserve_joint_names[j])
                return false;
        return true;
    }

    // What the gripper holds from the next cycle on; nullptr: nothing. The loop's own thread calls it.
    void carry(const lipserve_payload *payload)
    {
        carries_ = payload != nullptr;
        if (carries_)
            payload_ = *payload;
    }

    // One cycle: the torque of the model, where it has seen such motion and is sure enough; else none, so that the
    // feedback has to do it. Returns whether it was used.
    bool update(const Reference &reference, Joints &effort)
    {
        Joints tau_std;
        lipserve_torque_std_payload(reference.q.data(), reference.dq.data(), reference.ddq.data(),
                                    carries_ ? &payload_ : nullptr, effort.data(), tau_std.data());
        bool sure = lipserve_in_range(reference.q.data(), reference.dq.data(), reference.ddq.data()) != 0;
        for (const double each : tau_std)
            sure = sure && each < most_std_; // false where it is no number
        if (!sure)
            effort.fill(0.0);
        return sure;
    }

private:
    double most_std_ = 1.0; // N m; choose it joint by joint for your robot
    bool carries_ = false;
    lipserve_payload payload_ = {};
};

// Stands in for a trajectory: sinusoids about a posture.
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
            controller.carry(&held);
        const auto before = steady_clock::now();
        used += controller.update(desired(middle, 1e-3 * static_cast<double>(k)), effort);
        longest = std::fmax(longest, duration<double, std::micro>(steady_clock::now() - before).count());
        // here the effort goes to the drives, beside the feedback
    }
    std::printf("used %ld of %ld, the longest cycle took %.1f us\n", used, cycles, longest);
    if (used == 0)
        std::puts("none was used: name a posture that the training saw, lipserve_model.h says between which positions");
    return 0;
}
