// SPDX-License-Identifier: Apache-2.0
//
// A torque loop at 1 kHz. It uses the torque of a learnt model if the model is certain, and its own torque otherwise.
// With `teach`, the model also learns from measured torques.
//     controller MODEL [CYCLES] [teach]
//
// Replace `Rehearsal` by your robot, and send only torques that its sensors measure. This example does not limit
// torques: keep the limits and the emergency stop of your controller. Run it with real-time priority: chrt -f 80 …

#include <sys/mman.h>

#include <cmath>
#include <cstdio>
#include <lipserve/client.hpp>
#include <string>

namespace {

using lipserve::Deadline;
using lipserve::Status;

constexpr unsigned joints = 7;
constexpr std::int64_t period_ns = 1'000'000;
constexpr double budget_s = 0.0005;  // max time per cycle to wait for the answer
constexpr double max_std = 1.0;      // N·m, max standard deviation of torques to use; choose it for your robot

/// Replacement of a robot: it moves on sinusoids and its own torque is zero. It has no sensors: `measured` is the
/// commanded torque, which a model must not learn (the service rejects it as `implausible`).
struct Rehearsal {
  double q[joints] = {}, dq[joints] = {}, ddq[joints] = {}, own[joints] = {}, measured[joints] = {};

  void move(double seconds) {
    for (unsigned k = 0; k < joints; ++k) {
      const double rate = 0.5 + k / (joints - 1.0), phase = rate * seconds;
      q[k] = 0.3 * std::sin(phase) - (k == 3 ? 1.8 : 0.0) + (k == 5 ? 1.6 : 0.0);
      dq[k] = 0.3 * rate * std::cos(phase);
      ddq[k] = -0.3 * rate * rate * std::sin(phase);
    }
  }
  void command(const double* tau) {
    for (unsigned k = 0; k < joints; ++k) measured[k] = tau[k];
  }
};

bool is_certain(const lipserve::Answer& answer) {
  for (unsigned k = 0; k < joints; ++k)
    if (answer.tau_std[k] > max_std) return false;
  return !answer.late;
}

}  // namespace

int main(int count, char** arguments) {
  if (count < 2) return std::fputs("usage: controller MODEL [CYCLES] [teach]\n", stderr), 2;
  const long cycles = count > 2 ? std::atol(arguments[2]) : 5000;
  // the service remembers the sequences of a stream_id: use a new one for each run, or store the last sequence
  const std::string run = "controller-" + std::to_string(std::time(nullptr));
  lipserve::Options options;
  options.model = arguments[1];
  options.joints = joints;
  const bool teaches = count > 3 && std::string(arguments[3]) == "teach";
  if (teaches) options.stream_id = run.c_str();
  lipserve::Client client(options);
  if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0)
    std::fputs("warning: memory could not be locked and may be paged out\n", stderr);
  if (client.connect(Deadline::in(10.0)) != Status::ok) return std::fprintf(stderr, "%s\n", client.error().message), 1;

  Rehearsal robot;
  lipserve::Answer answer;
  if (client.gravity(robot.q, answer, Deadline::in(1.0)) == Status::ok)
    for (unsigned k = 0; k < joints; ++k)
      std::printf("gravity at joint %u: %.2f +- %.2f N m\n", k + 1, answer.gravity[k], 1.96 * answer.gravity_std[k]);
  long used = 0, unsure = 0, missed = 0, kept = 0;
  std::int64_t due = Deadline::now().ns;
  for (long cycle = 0; cycle < cycles; ++cycle) {
    robot.move(static_cast<double>(cycle) * 1e-3);
    const lipserve::Query query{robot.q, robot.dq, robot.ddq, teaches ? robot.measured : nullptr};
    // first request the torque of this cycle, then send the measured one; neither call waits longer than the budget
    const Status status = client.ask(query, answer, Deadline::in(budget_s));
    const bool use = status == Status::ok && is_certain(answer);
    ++(use ? used : status == Status::ok ? unsure : missed);
    robot.command(use ? answer.tau : robot.own);
    if (teaches) kept += client.teach(query) == Status::ok;

    due += period_ns;
    if (due < Deadline::now().ns) due = Deadline::now().ns;  // skip missed cycles
    const timespec moment{static_cast<time_t>(due / 1'000'000'000), static_cast<long>(due % 1'000'000'000)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &moment, nullptr);
  }

  std::printf("%ld cycles: %ld answers used, %ld late or uncertain, %ld missed\n", cycles, used, unsure, missed);
  if (!teaches) return 0;
  client.flush(Deadline::in(10.0));
  const lipserve::Learnt& learnt = client.learnt();
  std::printf("%ld torques sent: %llu learnt, %llu rejected, %llu refused, %zu torques not acknowledged\n", kept,
              static_cast<unsigned long long>(learnt.accepted), static_cast<unsigned long long>(learnt.rejected),
              static_cast<unsigned long long>(learnt.refused), client.unsettled());
  if (learnt.rejected)
    std::printf("for the reasons, run: lipserve alarms %s; lipserve learning batches %s --rejected\n", arguments[1],
                arguments[1]);
  if (*client.error().code) std::printf("last error: %s\n", client.error().message);
}
