// SPDX-License-Identifier: Apache-2.0
//
// Client for tests. It reads commands from standard input, one per line, and answers each with a line of JSON:
//     connect SECONDS | ask ROW SECONDS [std|learn|external …] | teach FROM TO | flush SECONDS | tick | close | end
//     gravity ROW SECONDS | mass_matrix ROW SECONDS | coriolis ROW SECONDS
//     loop CYCLES PERIOD_US BUDGET_US FIRST_ROW    calls `ask` and `teach` in every cycle; prints "cycle" in the middle
//     loop-ask CYCLES PERIOD_US BUDGET_US FIRST_ROW    only calls `ask`
// Options are arguments of the form name=value. rows=FILE: rows of 4 · joints doubles: q, dq, ddq, tau. alarms=1: a
// signal interrupts the client's system calls every 50 µs.

#include "allocations.hpp"

#include <sys/time.h>

#include <algorithm>
#include <csignal>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <lipserve/client.hpp>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace {

using lipserve::Deadline;
using lipserve::Status;

const char* name_of(Status status) {
  constexpr const char* names[] = {"ok", "timeout", "unreachable", "refused", "full", "invalid"};
  return names[static_cast<int>(status)];
}

std::string quoted(const char* text) {
  std::string out = "\"";
  for (; *text; ++text) {
    if (*text == '"' || *text == '\\') out += '\\';
    out += *text;
  }
  return out + '"';
}

template <class Value>
std::string member(const char* name, Value value) {
  std::ostringstream out;
  out.precision(17);
  out << ", \"" << name << "\": " << value;
  return out.str();
}

std::string list(const double* values, std::size_t count) {
  std::string out = "[";
  char number[32];
  for (std::size_t k = 0; k < count; ++k) {
    std::snprintf(number, sizeof number, "%.17g", values[k]);
    out += (k ? ", " : "") + std::string(values[k] == values[k] ? number : "NaN");
  }
  return out + "]";
}

/// Interrupts system calls during its lifetime, every 50 µs if alarms are enabled.
class Alarms {
 public:
  static void allow() {
    struct sigaction action {};
    action.sa_handler = [](int) { ++rung; };  // without SA_RESTART: what waits ends with EINTR
    sigaction(SIGALRM, &action, nullptr);
    allowed = true;
  }
  Alarms() { set(50); }
  ~Alarms() { set(0); }

  static inline volatile std::sig_atomic_t rung = 0;

 private:
  static void set(int period) {
    const itimerval every{{0, period}, {0, period}};
    if (allowed) setitimer(ITIMER_REAL, &every, nullptr);
  }
  static inline bool allowed = false;
};

class Driver {
 public:
  Driver(const lipserve::Options& options, const std::string& rows) : joints_(options.joints), client_(options) {
    std::ifstream file(rows, std::ios::binary);
    const std::string bytes((std::istreambuf_iterator<char>(file)), {});
    rows_.resize(bytes.size() / sizeof(double));
    if (!bytes.empty()) std::memcpy(rows_.data(), bytes.data(), rows_.size() * sizeof(double));
  }

  void run(std::istringstream& line) {
    std::string word;
    line >> word;
    Status status = Status::ok;
    double seconds = 0.0;
    std::size_t from = 0, to = 0;
    more_.clear();
    if (word == "connect") {
      line >> seconds;
      status = watched([&] { return client_.connect(Deadline::in(seconds)); });
    } else if (word == "flush") {
      line >> seconds;
      status = watched([&] { return client_.flush(Deadline::in(seconds)); });
    } else if (word == "ask") {
      line >> from >> seconds;
      lipserve::Query query = row(from);
      query.std = false;
      for (std::string flag; line >> flag;)
        (flag == "std" ? query.std : flag == "learn" ? query.learn : query.external) = true;
      lipserve::Answer answer;
      status = watched([&] { return client_.ask(query, answer, Deadline::in(seconds)); });
      if (status == Status::ok) say(answer);
    } else if (word == "gravity" || word == "mass_matrix" || word == "coriolis") {
      line >> from >> seconds;
      const lipserve::Query at = row(from);
      const Deadline until = Deadline::in(seconds);
      lipserve::Answer part;
      status = watched([&] {
        if (word == "gravity") return client_.gravity(at.q, part, until);
        return word == "coriolis" ? client_.coriolis(at.q, at.dq, part, until) : client_.mass_matrix(at.q, part, until);
      });
      if (part.gravity) more_ += member("mean", list(part.gravity, joints_));
      if (part.gravity_std) more_ += member("std", list(part.gravity_std, joints_));
      if (part.coriolis) more_ += member("mean", list(part.coriolis, joints_));
      if (part.mass_matrix) more_ += member("mean", list(part.mass_matrix, joints_ * joints_));
      more_ += member("late", part.late) + member("has_tau", part.tau != nullptr);
    } else if (word == "teach") {
      line >> from >> to;
      for (; from < to && status == Status::ok; ++from) {
        const lipserve::Query query = row(from);
        status = watched([&] { return client_.teach(query); });
      }
    } else if (word == "tick") {
      watched([&] { return client_.tick(), Status::ok; });
    } else if (word == "close") {
      watched([&] { return client_.close(), Status::ok; });
    } else if (word == "loop" || word == "loop-ask") {
      std::size_t cycles = 0, period = 0, budget = 0;
      line >> cycles >> period >> budget >> from;
      loop(cycles, period, budget, from, word == "loop");
    }
    report(status);
  }

 private:
  lipserve::Query row(std::size_t number) const {
    const double* const at = rows_.data() + number * 4 * joints_ % rows_.size();
    return {at, at + joints_, at + 2 * joints_, at + 3 * joints_};
  }

  template <class Call>
  static Status watched(Call call) {
    const Alarms alarms;
    const allocations::Watch watch;
    return call();
  }

  void loop(std::size_t cycles, std::size_t period, std::size_t budget, std::size_t from, bool teaches) {
    std::vector<double> trips;
    trips.reserve(cycles);
    std::map<std::string, std::size_t> seen;
    std::int64_t due = Deadline::now().ns;
    lipserve::Answer answer;
    for (std::size_t cycle = 0; cycle < cycles; ++cycle) {
      if (cycle == cycles / 2) std::puts("cycle"), std::fflush(stdout);
      const lipserve::Query query = row(from + cycle);
      const std::int64_t began = Deadline::now().ns;
      const Deadline until{began + static_cast<std::int64_t>(budget) * 1000};
      const Status status = watched([&] { return client_.ask(query, answer, until); });
      if (status == Status::ok) trips.push_back(static_cast<double>(Deadline::now().ns - began) / 1e3);
      ++seen[std::string("ask_") + name_of(status)];
      if (teaches) ++seen[std::string("teach_") + name_of(watched([&] { return client_.teach(query); }))];
      due += static_cast<std::int64_t>(period) * 1000;
      const timespec moment{static_cast<time_t>(due / 1'000'000'000), static_cast<long>(due % 1'000'000'000)};
      if (period) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &moment, nullptr);
    }
    for (const auto& [name, count] : seen) more_ += member(name.c_str(), count);
    std::sort(trips.begin(), trips.end());
    if (trips.empty()) return;
    const auto last = static_cast<double>(trips.size() - 1);
    const auto at = [&](double share) { return trips[static_cast<std::size_t>(share * last)]; };
    more_ += member("p50_us", at(0.5)) + member("p99_us", at(0.99)) + member("max_us", at(1.0));
  }

  void say(const lipserve::Answer& answer) {
    more_ += member("sequence", answer.sequence) + member("version", answer.version);
    more_ += member("revision", answer.revision) + member("late", answer.late) + member("tau", list(answer.tau, joints_));
    if (answer.tau_std) more_ += member("tau_std", list(answer.tau_std, joints_));
    if (answer.scale) more_ += member("scale", list(answer.scale, joints_));
    if (answer.tau_external) {
      more_ += member("tau_external", list(answer.tau_external, joints_));
      more_ += member("tau_external_std", list(answer.tau_external_std, joints_));
      more_ += member("tau_external_z", list(answer.tau_external_z, joints_));
      more_ += member("external_statistic", answer.external_statistic) + member("external_p", answer.external_p);
    }
    if (answer.has_payload)
      more_ += member("payload", list(&answer.payload_mass, 1)) + member("payload_std", list(&answer.payload_std, 1));
  }

  void report(Status status) const {
    const lipserve::Learnt& learnt = client_.learnt();
    const lipserve::Counters& counters = client_.counters();
    const lipserve::Error& error = client_.error();
    std::string out = "{\"status\": " + quoted(name_of(status)) + more_;
    out += member("allocations", allocations::count) + member("alarms", static_cast<long>(Alarms::rung));
    out += member("connected", client_.connected());
    out += member("unsettled", client_.unsettled()) + member("through", learnt.through);
    out += member("accepted", learnt.accepted) + member("duplicates", learnt.duplicates);
    out += member("rejected", learnt.rejected) + member("refused", learnt.refused);
    out += member("learnt_revision", learnt.revision) + member("asked", counters.asked);
    out += member("answered", counters.answered) + member("stale", counters.stale) + member("taught", counters.taught);
    out += member("resent", counters.resent) + member("connections", counters.connections);
    out += member("losses", counters.losses) + member("code", quoted(error.code));
    out += member("message", quoted(error.message)) + member("http", error.http) + member("close", error.close);
    out += member("refusal", quoted(client_.refusal().message)) + member("model_version", client_.hello().version);
    if (client_.connected()) {
      out += member("noise_std", list(client_.hello().noise_std, joints_));
      out += member("first_joint", quoted(client_.hello().joint_names[0]));
      out += member("torque_convention", quoted(client_.hello().torque_convention));
    }
    std::puts((out + "}").c_str());
    std::fflush(stdout);
  }

  std::size_t joints_;
  lipserve::Client client_;
  std::vector<double> rows_;
  std::string more_;
};

}  // namespace

int main(int count, char** arguments) {
  std::map<std::string, std::string> given;
  for (int k = 1; k < count; ++k) {
    const std::string argument = arguments[k];
    given[argument.substr(0, argument.find('='))] = argument.substr(argument.find('=') + 1);
  }
  const auto text = [&](const char* name) { return given.count(name) ? given[name].c_str() : nullptr; };
  const auto number = [&](const char* name, double usual) {
    return given.count(name) ? std::stod(given[name]) : usual;
  };
  lipserve::Options options;
  options.model = text("model"), options.url = text("url"), options.key = text("key");
  options.stream_id = text("stream_id"), options.alias = text("alias");
  options.joints = static_cast<unsigned>(number("joints", 2));
  options.version = static_cast<unsigned>(number("version", 0));
  options.scale = given.count("scale") > 0, options.payload = given.count("payload") > 0;
  options.rich = given.count("rich") > 0, options.without_gravity = given.count("without_gravity") > 0;
  options.first_sequence = static_cast<std::uint32_t>(number("first_sequence", 1));
  options.backlog = static_cast<std::size_t>(number("backlog", static_cast<double>(options.backlog)));
  options.window = static_cast<unsigned>(number("window", options.window));
  options.attempt_s = number("attempt_s", options.attempt_s);
  options.silence_s = number("silence_s", options.silence_s);
  if (!allocations::able()) return std::puts("cannot count allocations here"), 3;
  Driver driver(options, given["rows"]);
  if (given.count("alarms")) Alarms::allow();
  for (std::string line; std::getline(std::cin, line) && line != "end";) {
    std::istringstream words(line);
    driver.run(words);
  }
}
