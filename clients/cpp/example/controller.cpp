// SPDX-License-Identifier: Apache-2.0
//
// A torque loop of 1 kHz that uses a learnt model where that can be trusted, and its own torque where it cannot. With
// `teach` it also teaches the model what was measured.
//     controller MODEL [CYCLES] [teach]
//
// Put your robot in the place of `Rehearsal`, and teach nothing but what its sensors measure. Nothing here stands between a wrong torque and your hardware: keep the
// limits and the emergency stop of your controller. Run it with a real-time priority: chrt -f 80 controller …

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
constexpr double budget_s = 0.0005;  // of a cycle for the answer: what comes later is no use to this cycle
constexpr double most_std = 1.0;     // N·m: a torque that the model knows less well is not used; choose it for your robot

/// Stands in for a robot: it moves on sinusoids, its own torque is zero. It has no sensors: what it was told to exert
/// stands in for their torque, and a model is not to learn that (the service keeps it out as `implausible`).
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

bool sure(const lipserve::Answer& answer) {
  for (unsigned k = 0; k < joints; ++k)
    if (answer.tau_std[k] > most_std) return false;
  return !answer.late;
}

}  // namespace

int main(int count, char** arguments) {
  if (count < 2) return std::fputs("usage: controller MODEL [CYCLES] [teach]\n", stderr), 2;
  const long cycles = count > 2 ? std::atol(arguments[2]) : 5000;
  // a stream_id knows its sequences for good: one a run, unless the last sequence is kept over runs
  const std::string run = "controller-" + std::to_string(std::time(nullptr));
  lipserve::Options options;
  options.model = arguments[1];
  options.joints = joints;
  const bool teaches = count > 3 && std::string(arguments[3]) == "teach";
  if (teaches) options.stream_id = run.c_str();
  lipserve::Client client(options);
  if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0) std::fputs("memory is not locked: it may be paged out\n", stderr);
  if (client.connect(Deadline::in(10.0)) != Status::ok) return std::fprintf(stderr, "%s\n", client.error().message), 1;

  Rehearsal robot;
  lipserve::Answer answer;
  long used = 0, unsure = 0, missed = 0, kept = 0;
  std::int64_t due = Deadline::now().ns;
  for (long cycle = 0; cycle < cycles; ++cycle) {
    robot.move(static_cast<double>(cycle) * 1e-3);
    const lipserve::Query query{robot.q, robot.dq, robot.ddq, teaches ? robot.measured : nullptr};
    // first the torque that this cycle needs, then what it measured; neither waits for longer than the budget
    const Status status = client.ask(query, answer, Deadline::in(budget_s));
    const bool use = status == Status::ok && sure(answer);
    ++(use ? used : status == Status::ok ? unsure : missed);
    robot.command(use ? answer.tau : robot.own);
    if (teaches) kept += client.teach(query) == Status::ok;

    due += period_ns;
    if (due < Deadline::now().ns) due = Deadline::now().ns;  // a cycle that took too long is not made up for
    const timespec moment{static_cast<time_t>(due / 1'000'000'000), static_cast<long>(due % 1'000'000'000)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &moment, nullptr);
  }

  std::printf("%ld cycles: %ld answers used, %ld late or unsure, %ld missed\n", cycles, used, unsure, missed);
  if (!teaches) return 0;
  client.flush(Deadline::in(10.0));
  const lipserve::Learnt& learnt = client.learnt();
  std::printf("%ld torques taught: %llu learnt, %llu kept out, %llu refused, %zu torques not acknowledged\n", kept,
              static_cast<unsigned long long>(learnt.accepted), static_cast<unsigned long long>(learnt.rejected),
              static_cast<unsigned long long>(learnt.refused), client.unsettled());
  if (learnt.rejected)
    std::printf("why: lipserve alarms %s; lipserve learning batches %s --rejected\n", arguments[1], arguments[1]);
  if (*client.error().code) std::printf("last error: %s\n", client.error().message);
}
