// SPDX-License-Identifier: Apache-2.0
//
// LIPServe torque stream for controllers: one header, C++17 and POSIX sockets only.
//
//     lipserve::Options options;
//     options.model = "panda-sim";
//     options.joints = 7;
//     lipserve::Client client(options);                 // allocates all memory
//     if (client.connect(lipserve::Deadline::in(5.0)) != lipserve::Status::ok) puts(client.error().message);
//     lipserve::Answer answer;
//     lipserve::Query query{q, dq, ddq};
//     if (client.ask(query, answer, lipserve::Deadline::in(0.0005)) == lipserve::Status::ok) use(answer.tau);
//
// Guarantees of every call:
//   - It never waits beyond its deadline on CLOCK_MONOTONIC. Data that have arrived by the last check are used.
//   - It does not allocate, throw, lock or raise SIGPIPE. Only the constructor allocates. It does not throw: if an
//     option is wrong, every call returns `invalid`.
//   - Calls reconnect after a lost connection, step by step, within their own deadlines.
//   - Torques given to `teach` are kept until the service acknowledges them. After a reconnection they are sent again
//     with the same sequence, and the service learns them once.
// Use a client from one thread at a time. There is no TLS: use a proxy on the controller's host, or a Unix socket.
// Protocol: docs/reference/stream-protocol.md.

#ifndef LIPSERVE_CLIENT_HPP
#define LIPSERVE_CLIENT_HPP

#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <memory>
#include <new>

namespace lipserve {

// ---------------------------------------------------------------------------------------------------------------------
// Types of the interface
// ---------------------------------------------------------------------------------------------------------------------

enum class Status : std::uint8_t {
  ok,
  timeout,      // connected, but no answer by the deadline: the last received answer, if any, is returned as `late`;
                // an answer that arrives afterwards is dropped and counted as stale
  unreachable,  // not connected; the client reconnects as soon as the service is available
  refused,      // the service rejected this query or the connection
  full,         // `Options::backlog` torques are not acknowledged yet; this one is not kept
  invalid,      // an argument or an option is invalid
};

/// Point in time on CLOCK_MONOTONIC.
struct Deadline {
  std::int64_t ns = 0;

  static Deadline now() {
    timespec moment{};
    clock_gettime(CLOCK_MONOTONIC, &moment);
    return at(moment);
  }
  /// From a timespec as used by clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, …).
  static Deadline at(const timespec& moment) {
    return {std::int64_t{moment.tv_sec} * 1'000'000'000 + std::int64_t{moment.tv_nsec}};
  }
  /// Seconds from now, between 0 and a year.
  static Deadline in(double seconds) { return {now().ns + span(seconds)}; }
  /// Convert seconds to nanoseconds, limited to 0 to a year.
  static std::int64_t span(double seconds) {
    constexpr double year = 31'536'000.0;
    return seconds > 0.0 ? static_cast<std::int64_t>((seconds < year ? seconds : year) * 1e9) : 0;
  }
};

/// What a query asks for: the torque, or a part of M(q) ddq + Coriolis torque + gravity.
enum class Kind : std::uint8_t { torque = 0, gravity = 8, mass_matrix = 16, coriolis = 32 };

/// One motion, with arrays of `joints` numbers: q, rad (prismatic: m); dq, rad/s (m/s); ddq, rad/s² (m/s²); optional
/// measured torque tau, N·m (N).
struct Query {
  const double* q = nullptr;
  const double* dq = nullptr;
  const double* ddq = nullptr;
  const double* tau = nullptr;
  bool std = true;        // request tau_std
  bool external = false;  // request the external torque: the part of tau that the model does not explain
  bool learn = false;     // for `ask`: let the model learn from tau after the answer
  double budget = 0.0;    // max time in the service before it counts the answer as late, s; 0: none
  Kind kind = Kind::torque;  // other kinds need q alone, or q and dq; tau, external and learn are then ignored
};

/// Answer of the service; torques in N·m (N). Arrays have `joints` numbers and are null if not requested. The client
/// owns them; they are valid until its next call.
struct Answer {
  std::uint32_t sequence = 0;
  std::uint32_t version = 0;
  std::uint64_t revision = 0;      // number of online updates included
  bool late = false;               // received after the deadline, or sent by the service after the query's budget
  std::uint32_t late_answers = 0;  // number of late answers of this connection
  double seconds = 0.0;            // time in the service, s
  const double* tau = nullptr;
  const double* tau_std = nullptr;           // standard deviation of the predicted torque, without measurement noise
  /// Factor on the half width of intervals: 95 % of measurements are in tau ± 1.96 · scale · √(tau_std² + noise_std²).
  const double* scale = nullptr;
  // answers to queries of another kind have these arrays alone
  const double* gravity = nullptr;
  const double* gravity_std = nullptr;
  const double* mass_matrix = nullptr;       // joints × joints, row by row, kg·m²; with rotors, symmetric
  const double* coriolis = nullptr;          // Coriolis and centrifugal torque
  const double* tau_external = nullptr;      // measured − predicted torque. Not a safety function
  const double* tau_external_std = nullptr;
  const double* tau_external_z = nullptr;
  double external_statistic = 0.0;           // χ² statistic of all joints
  double external_p = 0.0;                   // probability of a larger statistic without external torque
  /// The training data do not determine some joint's torque at this motion; that torque is gravity, offset and friction
  /// only, or the mean of the training data.
  bool fallback = false;
  bool has_payload = false;
  double payload_mass = 0.0;                 // estimated mass, kg; both NaN without a payload
  double payload_std = 0.0;
};

/// Last error, with a text for people.
struct Error {
  Status status = Status::ok;
  int http = 0;                    // HTTP status of a refused connection
  int close = 0;                   // close code of a connection closed by the service
  std::uint32_t sequence = 0;      // sequence of the rejected query
  char code[40] = {};              // code of the service, or unreachable, closed, timeout, protocol, full, invalid
  char message[600] = {};
};

/// Totals of the torques that were sent to learn from; all of them are durable in the service.
struct Learnt {
  struct Count {
    char code[24] = {};
    std::uint64_t count = 0;
  };
  std::int64_t through = -1;       // newest sequence that is acknowledged or refused; -1: none
  std::uint64_t accepted = 0;      // new and learnt from
  std::uint64_t duplicates = 0;    // logged before: their first acknowledgement was lost
  std::uint64_t rejected = 0;      // logged but not learnt; `codes` has the numbers by code
  Count codes[12];
  std::uint64_t refused = 0;       // not logged, so lost; `Client::refusal` has the reason
  std::uint64_t revision = 0;      // answers of this revision and later ones include these torques
};

struct Counters {
  std::uint64_t asked = 0, answered = 0;   // queries and answers of `ask`
  std::uint64_t stale = 0;                 // answers that arrived after their `ask` had returned
  std::uint64_t taught = 0;                // torques kept by `teach` or `ask`
  std::uint64_t resent = 0;                // torques sent again over a new connection
  std::uint64_t connections = 0, losses = 0;
};

/// Description of the version that answers.
struct Hello {
  std::uint32_t version = 0;
  std::uint64_t revision = 0;
  char torque_convention[64] = {};
  double max_position = 0.0;
  const double* noise_std = nullptr;            // standard deviation of a measurement around the torque, N·m
  const char (*joint_names)[64] = nullptr;
};

/// Options of a client. Strings must be valid only during construction.
struct Options {
  const char* model = nullptr;
  unsigned joints = 0;
  const char* url = nullptr;        // http://host:port or unix:///path; null: LIPSERVE_URL, else http://127.0.0.1:8000
  const char* key = nullptr;        // API key; null: LIPSERVE_API_KEY, else none
  const char* stream_id = nullptr;  // name of the robot or recording to learn from; null: do not learn
  const char* alias = nullptr;      // alias of the version, followed if it moves
  unsigned version = 0;             // version number; without version and alias: the serving version
  bool scale = false;               // request the factor on intervals with every answer
  bool payload = false;             // request the estimated payload with every answer
  bool rich = false;                // answer from all centres of a correction, which takes longer
  bool without_gravity = false;     // torques minus gravity, for robots that add it
  /// Sequence of the first frame. The service remembers the sequences of a stream_id: to continue one, start above the
  /// last sequence sent.
  std::uint32_t first_sequence = 1;
  /// Max number of unacknowledged torques: the default is 16 s at 1 kHz, 4 MB for seven joints.
  std::size_t backlog = 16384;
  /// Max number of unanswered frames, for queries and for torques to learn from. Torques that are sent again after a
  /// reconnection delay an `ask` by at most so many answers.
  unsigned window = 4;
  double attempt_s = 2.0;           // max duration of one attempt to connect, s
  double silence_s = 3.0;           // if no answer arrives for this time, the connection counts as lost, s
  double retry_first_s = 0.01;      // pause before the next attempt to connect, s; doubles each time
  double retry_most_s = 1.0;        // max pause, s
};

// ---------------------------------------------------------------------------------------------------------------------
// Frame layout 1: little-endian, no padding
// ---------------------------------------------------------------------------------------------------------------------

namespace frames {

constexpr int layout = 1;
constexpr std::size_t request_head = 16, answer_head = 32;
constexpr unsigned ask_std = 1, ask_learn = 2, ask_external = 4;
constexpr unsigned has_std = 1, late = 2, error = 4, unread = 8, has_scale = 16, has_external = 32, has_payload = 64;
constexpr unsigned fallback = 128, has_gravity = 256, has_mass_matrix = 512, has_coriolis = 1024;

/// Write the low bytes of a number; return the end.
inline std::uint8_t* put(std::uint8_t* out, std::uint64_t value, unsigned bytes) {
  for (unsigned k = 0; k < bytes; ++k) *out++ = static_cast<std::uint8_t>(value >> (8 * k));
  return out;
}

inline std::uint64_t get(const std::uint8_t* in, unsigned bytes) {
  std::uint64_t value = 0;
  for (unsigned k = 0; k < bytes; ++k) value |= std::uint64_t{in[k]} << (8 * k);
  return value;
}

inline std::uint8_t* put(std::uint8_t* out, double value) {
  std::uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof bits);
  return put(out, bits, 8);
}

inline double get(const std::uint8_t* in) {
  const std::uint64_t bits = get(in, 8);
  double value = 0.0;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

constexpr std::size_t request_bytes(std::size_t joints, bool tau) { return request_head + (tau ? 4 : 3) * 8 * joints; }

/// Max number of values of an answer: mean, std, scale, three arrays of external torque; statistic, p, payload's two; or
/// the mass matrix.
constexpr std::size_t answer_numbers(std::size_t joints) {
  return joints * joints > 6 * joints + 4 ? joints * joints : 6 * joints + 4;
}

/// Number of arrays of a request: the first of q, dq, ddq and tau.
inline std::size_t vectors(const Query& query) {
  if (query.kind != Kind::torque) return query.kind == Kind::coriolis ? 2 : 1;
  return query.learn || query.external ? 4 : 3;
}

/// Write a request to a buffer of `request_bytes`; return its length.
inline std::size_t write(std::uint8_t* out, std::uint32_t sequence, const Query& query, std::size_t joints) {
  unsigned flags = static_cast<unsigned>(query.kind);
  if (query.std && (flags == 0 || query.kind == Kind::gravity)) flags |= ask_std;
  if (query.kind == Kind::torque) flags |= (query.learn ? ask_learn : 0U) | (query.external ? ask_external : 0U);
  std::uint8_t* end = put(put(put(put(out, sequence, 4), flags, 2), joints, 2), query.budget);
  const double* const parts[] = {query.q, query.dq, query.ddq, query.tau};
  for (std::size_t part = 0; part < vectors(query); ++part)
    for (std::size_t joint = 0; joint < joints; ++joint) end = put(end, parts[part][joint]);
  return static_cast<std::size_t>(end - out);
}

/// Read an answer that is not an error; return false if length or number of joints do not match. The answer points into
/// `numbers`, a buffer of `answer_numbers`.
inline bool read(const std::uint8_t* data, std::size_t size, std::size_t joints, double* numbers, Answer& answer) {
  if (size < answer_head) return false;
  const std::uint64_t flags = get(data + 4, 2);
  const std::size_t arrays = (flags & has_mass_matrix ? joints : 1U) + (flags & has_std ? 1U : 0U) +
                             (flags & has_scale ? 1U : 0U) + (flags & has_external ? 3U : 0U);
  const std::size_t count = arrays * joints + (flags & has_external ? 2U : 0U) + (flags & has_payload ? 2U : 0U);
  if (flags & error || count > answer_numbers(joints) || get(data + 6, 2) != joints || size != answer_head + 8 * count) return false;
  for (std::size_t k = 0; k < count; ++k) numbers[k] = get(data + answer_head + 8 * k);
  answer = Answer{};
  answer.sequence = static_cast<std::uint32_t>(get(data, 4));
  answer.late = (flags & late) != 0;
  answer.version = static_cast<std::uint32_t>(get(data + 8, 4));
  answer.late_answers = static_cast<std::uint32_t>(get(data + 12, 4));
  answer.revision = get(data + 16, 8);
  answer.seconds = get(data + 24);
  const double* next = numbers;
  const auto take = [&next](std::size_t many) { return (next += many) - many; };
  if (flags & has_mass_matrix) {
    answer.mass_matrix = take(joints * joints);
  } else if (flags & has_coriolis) {
    answer.coriolis = take(joints);
  } else {
    (flags & has_gravity ? answer.gravity : answer.tau) = take(joints);
    if (flags & has_std) (flags & has_gravity ? answer.gravity_std : answer.tau_std) = take(joints);
  }
  if (flags & has_scale) answer.scale = take(joints);
  if (flags & has_external) {
    answer.tau_external = take(joints);
    answer.tau_external_std = take(joints);
    answer.tau_external_z = take(joints);
    answer.external_statistic = *take(1);
    answer.external_p = *take(1);
  }
  answer.fallback = (flags & fallback) != 0;
  answer.has_payload = (flags & has_payload) != 0;
  if (answer.has_payload) {
    answer.payload_mass = *take(1);
    answer.payload_std = *take(1);
  }
  return true;
}

}  // namespace frames

namespace detail {

// ---------------------------------------------------------------------------------------------------------------------
// Text without allocation
// ---------------------------------------------------------------------------------------------------------------------

/// Appends to a zero-terminated buffer; text that does not fit is cut off at a whole UTF-8 character.
class Text {
 public:
  template <std::size_t Size>
  explicit Text(char (&buffer)[Size]) : Text(buffer, Size) {}
  Text(char* buffer, std::size_t size) : begin_(buffer), next_(buffer), last_(buffer + size - 1) { *buffer = 0; }

  Text& add(char letter) {
    if (next_ == last_) {
      full_ = true;
    } else if (!full_) {
      *next_++ = letter;
      *next_ = 0;
    }
    return *this;
  }
  Text& add(const char* text) {
    while (*text) add(*text++);
    return trimmed();
  }
  Text& add(const char* text, std::size_t size) {
    for (std::size_t k = 0; k < size; ++k) add(text[k]);
    return trimmed();
  }
  Text& add(std::int64_t number) {
    if (number < 0) add('-');
    return add(number < 0 ? ~static_cast<std::uint64_t>(number) + 1 : static_cast<std::uint64_t>(number));
  }
  Text& add(std::uint64_t number) {
    char digits[20];
    std::size_t count = 0;
    do digits[count++] = static_cast<char>('0' + number % 10);
    while (number /= 10);
    while (count) add(digits[--count]);
    return *this;
  }
  Text& add(int number) { return add(std::int64_t{number}); }
  Text& add(unsigned number) { return add(std::uint64_t{number}); }
  /// Append a Unicode character as UTF-8.
  Text& character(std::uint32_t code) {
    const auto tail = [code](unsigned shift) { return static_cast<char>(0x80U | ((code >> shift) & 0x3FU)); };
    if (code < 0x80) return add(static_cast<char>(code));
    char bytes[4];
    std::size_t count = 0;
    if (code < 0x800) {
      bytes[count++] = static_cast<char>(0xC0U | (code >> 6));
    } else if (code < 0x10000) {
      bytes[count++] = static_cast<char>(0xE0U | (code >> 12));
      bytes[count++] = tail(6);
    } else {
      bytes[count++] = static_cast<char>(0xF0U | (code >> 18));
      bytes[count++] = tail(12);
      bytes[count++] = tail(6);
    }
    bytes[count++] = tail(0);
    return add(bytes, count);
  }
  /// Append text percent-encoded for a URL: all but letters, digits and -._~ become %XX.
  Text& quoted(const char* text) {
    for (; *text; ++text) {
      const auto byte = static_cast<std::uint8_t>(*text);
      const bool plain = (byte | 32U) - 'a' < 26U || byte - unsigned{'0'} < 10U || (byte && std::strchr("-._~", byte));
      if (plain) add(*text);
      else add('%').add("0123456789ABCDEF"[byte >> 4]).add("0123456789ABCDEF"[byte & 15]);
    }
    return *this;
  }
  bool full() const { return full_; }
  std::size_t size() const { return static_cast<std::size_t>(next_ - begin_); }

 private:
  Text& trimmed() {
    if (!full_) return *this;
    char* start = next_;  // start of the last character
    while (start != begin_ && (static_cast<std::uint8_t>(start[-1]) & 0xC0U) == 0x80U) --start;
    if (start == begin_) return *this;
    const auto lead = static_cast<std::uint8_t>(*--start);
    const std::ptrdiff_t length = lead < 0x80 ? 1 : lead < 0xE0 ? 2 : lead < 0xF0 ? 3 : 4;
    if (next_ - start < length) *(next_ = start) = 0;
    return *this;
  }
  char *begin_, *next_, *last_;
  bool full_ = false;
};

/// Value within a JSON text, read in place. If the text is truncated, the part before the cut can be read.
class Json {
 public:
  Json() = default;
  Json(const char* begin, const char* end) : at_(space(begin, end)), end_(end) {}

  bool there() const { return at_ != nullptr && at_ != end_; }
  /// Return a member of an object, or an empty value.
  Json member(const char* name) const {
    Json found;
    each([&](const Json& key, const Json& value) {
      char known[32];
      if (!found.there() && key.text(known, sizeof known) && std::strcmp(known, name) == 0) found = value;
      return !found.there();
    });
    return found;
  }
  /// Call visit(key, value) for members of an object or elements of an array (without key), while it returns true.
  template <class Visit>
  void each(Visit visit) const {
    if (!there() || (*at_ != '{' && *at_ != '[')) return;
    const bool object = *at_ == '{';
    const char* at = space(at_ + 1, end_);
    while (at != end_ && *at != '}' && *at != ']') {
      Json key;
      if (object) {
        key = Json(at, end_);
        at = space(past(at, end_), end_);
        if (at == end_ || *at != ':') return;
        at = space(at + 1, end_);
      }
      if (!visit(key, Json(at, end_))) return;
      at = space(past(at, end_), end_);
      if (at != end_ && *at == ',') at = space(at + 1, end_);
      else return;
    }
  }
  /// Copy a string as far as it fits; return false if the value is not a string.
  bool text(char* out, std::size_t size) const {
    Text copy(out, size);
    if (!there() || *at_ != '"') return false;
    for (const char* at = at_ + 1; at != end_ && *at != '"'; ++at) {
      if (*at != '\\') {
        copy.add(*at);
        continue;
      }
      if (++at == end_) break;
      if (*at == 'u') {
        std::uint32_t code = hex(at + 1);
        if (code >> 10 == 0x36 && end_ - at > 10 && at[5] == '\\' && at[6] == 'u') {  // first half of a surrogate pair
          code = 0x10000 + ((code & 0x3FFU) << 10) + (hex(at + 7) & 0x3FFU);
          at += 6;
        }
        at += end_ - at > 4 ? 4 : end_ - at - 1;
        copy.character(code);
      } else {
        copy.add(unescaped(*at));
      }
    }
    copy.add("");  // trims a partial character at the end
    return true;
  }
  /// Return a number, accurate to about the last digit and independent of the locale (unlike strtod); `otherwise` if
  /// the value is not a number.
  double number(double otherwise) const {
    if (!there()) return otherwise;
    const char* at = at_;
    const bool negative = *at == '-';
    if (negative) ++at;
    long double value = 0.0L;
    int exponent = 0;
    bool digits = false;
    for (bool fraction = false; at != end_ && (digit(*at) || (*at == '.' && !fraction)); ++at) {
      if (*at == '.') {
        fraction = true;
        continue;
      }
      value = value * 10.0L + static_cast<long double>(*at - '0');
      exponent -= fraction;
      digits = true;
    }
    if (!digits) return otherwise;
    if (at != end_ && (*at | 32) == 'e') {
      const bool down = ++at != end_ && *at == '-';
      if (at != end_ && (*at == '-' || *at == '+')) ++at;
      int written = 0;
      for (; at != end_ && digit(*at); ++at) written = written < 10000 ? written * 10 + (*at - '0') : written;
      exponent += down ? -written : written;
    }
    for (; exponent > 0; --exponent) value *= 10.0L;
    long double divisor = 1.0L;
    for (; exponent < 0 && exponent > -4000; ++exponent) divisor *= 10.0L;
    value /= divisor;
    return static_cast<double>(negative ? -value : value);
  }
  /// Return an integer; -1 if the value is not one.
  std::int64_t integer() const {
    if (!there()) return -1;
    const char* at = *at_ == '-' ? at_ + 1 : at_;
    if (at == end_ || !digit(*at)) return -1;
    std::int64_t value = 0;
    for (; at != end_ && digit(*at) && value < INT64_MAX / 10 - 9; ++at) value = value * 10 + (*at - '0');
    return *at_ == '-' ? -value : value;
  }
  std::uint64_t count() const {
    const std::int64_t value = integer();
    return value < 0 ? 0 : static_cast<std::uint64_t>(value);
  }

 private:
  static char unescaped(char letter) {
    switch (letter) {
      case 'n': return '\n';
      case 't': return '\t';
      case 'r': return '\r';
      case 'b': return '\b';
      case 'f': return '\f';
      default: return letter;
    }
  }
  static bool digit(char letter) { return letter >= '0' && letter <= '9'; }
  static const char* space(const char* at, const char* end) {
    while (at != end && (*at == ' ' || *at == '\t' || *at == '\n' || *at == '\r')) ++at;
    return at;
  }
  /// Return the end of a value.
  static const char* past(const char* at, const char* end) {
    int depth = 0;
    bool quoted = false;
    for (; at != end; ++at) {
      if (quoted) {
        if (*at == '\\' && at + 1 != end) ++at;
        else if (*at == '"') quoted = false;
      } else if (*at == '"') {
        quoted = true;
      } else if (*at == '{' || *at == '[') {
        ++depth;
      } else if (*at == '}' || *at == ']') {
        if (--depth < 0) return at;
      } else if (depth == 0 && (*at == ',' || *at == ':')) {
        return at;
      }
      if (depth == 0 && !quoted && (*at == '"' || *at == '}' || *at == ']')) return at + 1;
    }
    return end;
  }
  std::uint32_t hex(const char* at) const {
    std::uint32_t code = 0;
    for (int k = 0; k < 4 && at != end_; ++k, ++at) {
      const auto letter = static_cast<std::uint32_t>(static_cast<std::uint8_t>(*at));
      code = code * 16 + (letter <= '9' ? letter - '0' : (letter | 32U) - 'a' + 10) % 16;
    }
    return code;
  }
  const char* at_ = nullptr;
  const char* end_ = nullptr;
};

// ---------------------------------------------------------------------------------------------------------------------
// WebSocket (RFC 6455)
// ---------------------------------------------------------------------------------------------------------------------

/// SHA-1 for the handshake; not for secrets.
inline void sha1(const std::uint8_t* data, std::size_t size, std::uint8_t (&digest)[20]) {
  std::uint32_t state[5] = {0x67452301U, 0xEFCDAB89U, 0x98BADCFEU, 0x10325476U, 0xC3D2E1F0U};
  const auto turn = [](std::uint32_t value, unsigned by) { return value << by | value >> (32 - by); };
  const std::size_t blocks = (size + 8) / 64 + 1;
  for (std::size_t block = 0; block < blocks; ++block) {
    std::uint32_t words[80] = {};
    for (std::size_t k = 0; k < 64; ++k) {
      const std::size_t place = 64 * block + k, last = 64 * blocks - 1 - place;
      std::uint32_t byte = place < size ? data[place] : place == size ? 0x80U : 0U;
      if (place > size && last < 8) byte = static_cast<std::uint8_t>(std::uint64_t{size} * 8 >> (8 * last));
      words[k / 4] = words[k / 4] << 8 | byte;
    }
    for (std::size_t k = 16; k < 80; ++k)
      words[k] = turn(words[k - 3] ^ words[k - 8] ^ words[k - 14] ^ words[k - 16], 1);
    std::uint32_t a = state[0], b = state[1], c = state[2], d = state[3], e = state[4];
    for (std::size_t k = 0; k < 80; ++k) {
      const std::uint32_t mixed = k < 20   ? ((b & c) | (~b & d)) + 0x5A827999U
                                  : k < 40 ? (b ^ c ^ d) + 0x6ED9EBA1U
                                  : k < 60 ? ((b & c) | (b & d) | (c & d)) + 0x8F1BBCDCU
                                           : (b ^ c ^ d) + 0xCA62C1D6U;
      const std::uint32_t next = turn(a, 5) + mixed + e + words[k];
      e = d, d = c, c = turn(b, 30), b = a, a = next;
    }
    state[0] += a, state[1] += b, state[2] += c, state[3] += d, state[4] += e;
  }
  for (std::size_t k = 0; k < 20; ++k) digest[k] = static_cast<std::uint8_t>(state[k / 4] >> (24 - 8 * (k % 4)));
}

/// Write base64 text: 4 ⌈size / 3⌉ characters and a 0.
inline void base64(const std::uint8_t* data, std::size_t size, char* out) {
  constexpr char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  for (std::size_t k = 0; k < size; k += 3) {
    const std::size_t left = size - k;
    const std::uint32_t bits = std::uint32_t{data[k]} << 16 | (left > 1 ? std::uint32_t{data[k + 1]} << 8 : 0U) |
                               (left > 2 ? std::uint32_t{data[k + 2]} : 0U);
    *out++ = letters[bits >> 18];
    *out++ = letters[bits >> 12 & 63U];
    *out++ = left > 1 ? letters[bits >> 6 & 63U] : '=';
    *out++ = left > 2 ? letters[bits & 63U] : '=';
  }
  *out = 0;
}

/// Write the Sec-WebSocket-Accept for a Sec-WebSocket-Key of 24 characters: 28 characters and a 0.
inline void accept_of(const char* key, char (&out)[29]) {
  char joined[64];
  Text text(joined);
  text.add(key).add("258EAFA5-E914-47DA-95CA-C5AB0DC85B11");
  std::uint8_t bytes[64], digest[20];
  std::memcpy(bytes, joined, text.size());
  sha1(bytes, text.size(), digest);
  base64(digest, sizeof digest, out);
}

enum Opcode : std::uint8_t { continued = 0, text = 1, binary = 2, closing = 8, ping = 9, pong = 10 };

constexpr std::size_t most_head = 14;  // max bytes before the payload of a frame
constexpr std::size_t most_control = 125;  // max bytes of a ping, pong or close

/// Write a message as one masked frame; return its length, at most `most_head` more than that of the payload.
inline std::size_t seal(std::uint8_t* out, Opcode opcode, const std::uint8_t* payload, std::size_t size,
                        std::uint32_t mask) {
  std::uint8_t* next = out;
  *next++ = static_cast<std::uint8_t>(0x80U | opcode);
  const unsigned wide = size < 126 ? 0 : size < 65536 ? 2 : 8;  // bytes of an extended length
  *next++ = static_cast<std::uint8_t>(0x80U | (wide == 0 ? size : wide == 2 ? 126U : 127U));
  for (unsigned k = wide; k-- > 0;) *next++ = static_cast<std::uint8_t>(std::uint64_t{size} >> (8 * k));
  std::uint8_t key[4];
  frames::put(key, mask, 4);
  std::memcpy(next, key, 4);
  next += 4;
  for (std::size_t k = 0; k < size; ++k) *next++ = static_cast<std::uint8_t>(payload[k] ^ key[k % 4]);
  return static_cast<std::size_t>(next - out);
}

/// Extracts messages from pieces of a byte stream. Of a message larger than the buffer, only the beginning is kept.
class Inbox {
 public:
  enum class Event : std::uint8_t { more, message, control, broken };

  void use(std::uint8_t* buffer, std::size_t capacity) { data = buffer, capacity_ = capacity; }
  void reset() { have_ = 0, need_ = 2, inside_ = open_ = false, size = length = 0, why = nullptr; }

  /// Process bytes from `at` on until a message is complete (then call again) or all bytes are used (`more`). After
  /// `broken`, call `reset`.
  Event take(const std::uint8_t*& at, const std::uint8_t* end) {
    for (;;) {
      if (why) return Event::broken;
      if (!inside_) {
        for (; have_ < need_; ++at) {
          if (at == end) return Event::more;
          head_[have_++] = *at;
          if (have_ == 2) need_ = (head_[1] & 127U) < 126 ? 2 : (head_[1] & 127U) == 126 ? 4 : 10;
        }
        if (!begin()) return Event::broken;
      }
      const auto there = static_cast<std::size_t>(end - at);
      const std::size_t part = left_ < there ? static_cast<std::size_t>(left_) : there;
      copy(at, part);
      at += part;
      if ((left_ -= part) != 0) return Event::more;
      inside_ = false, have_ = 0, need_ = 2;
      if (opcode & 8U) return Event::control;
      if (head_[0] & 0x80U) {
        open_ = false;
        return Event::message;
      }
    }
  }

  Opcode opcode = binary;          // opcode of the message or control frame
  std::uint8_t* data = nullptr;    // message
  std::size_t size = 0;            // bytes of the message in the buffer
  std::uint64_t length = 0;        // bytes of the whole message
  std::uint8_t control[most_control];
  std::size_t control_size = 0;
  const char* why = nullptr;       // reason if broken

 private:
  bool begin() {
    const unsigned code = head_[0] & 15U, given = head_[1] & 127U;
    left_ = given;
    if (given > 125) {
      left_ = 0;
      for (unsigned k = 2; k < need_; ++k) left_ = left_ << 8 | head_[k];
    }
    inside_ = true;
    if (head_[0] & 0x70U) return fail("the service sent a frame with an extension that was not negotiated");
    if (head_[1] & 0x80U) return fail("the service sent a masked frame");
    if (left_ >> 63) return fail("the service sent a frame with an invalid length");
    if (code & 8U) {
      if (code > pong) return fail("the service sent a frame with an unknown opcode");
      if (left_ > most_control || !(head_[0] & 0x80U)) return fail("the service sent an invalid control frame");
      control_size = 0;
    } else {
      if (code > binary) return fail("the service sent a frame with an unknown opcode");
      if ((code == continued) != open_) return fail("the service sent fragments of messages out of order");
      if (code != continued) message_ = static_cast<Opcode>(code), size = 0, length = 0;
      open_ = true;
    }
    opcode = code & 8U ? static_cast<Opcode>(code) : message_;
    return true;
  }
  bool fail(const char* reason) {
    why = reason;
    return false;
  }
  void copy(const std::uint8_t* from, std::size_t part) {
    if (opcode & 8U) {
      if (part) std::memcpy(control + control_size, from, part);
      control_size += part;
      return;
    }
    length += part;
    const std::size_t kept = part < capacity_ - size ? part : capacity_ - size;
    if (kept) std::memcpy(data + size, from, kept);
    size += kept;
  }
  std::uint8_t head_[10];
  std::size_t have_ = 0, need_ = 2, capacity_ = 0;
  std::uint64_t left_ = 0;
  bool inside_ = false;  // within the payload of a frame
  bool open_ = false;    // within a fragmented message
  Opcode message_ = binary;
};

/// SplitMix64 for masks of frames. Masks protect proxies from browser scripts; here they need not be secret.
class Random {
 public:
  /// Seed the generator; called once, before the control loop.
  void seed() {
    const int device = open("/dev/urandom", O_RDONLY | O_CLOEXEC);
    if (device < 0 || ::read(device, &state_, sizeof state_) != static_cast<ssize_t>(sizeof state_))
      state_ = static_cast<std::uint64_t>(Deadline::now().ns) ^ static_cast<std::uint64_t>(getpid()) << 32;
    if (device >= 0) ::close(device);
  }
  std::uint64_t next() {
    std::uint64_t mixed = state_ += 0x9E3779B97F4A7C15U;
    mixed = (mixed ^ mixed >> 30) * 0xBF58476D1CE4E5B9U;
    mixed = (mixed ^ mixed >> 27) * 0x94D049BB133111EBU;
    return mixed ^ mixed >> 31;
  }

 private:
  std::uint64_t state_ = 0;
};

/// Return a text for an errno; strerror may allocate.
inline const char* words(int number) {
  switch (number) {
    case ECONNREFUSED: return "connection refused: is the service running?";
    case ECONNRESET: return "the connection was reset";
    case EPIPE: return "the connection was closed";
    case ENOENT: return "the socket does not exist";
    case EACCES: return "permission denied";
    case EHOSTUNREACH: return "no route to the host";
    case ENETUNREACH: return "no route to the network";
    case ETIMEDOUT: return "the connection timed out";
    case EAGAIN: return "the service's queue of connections is full";
    case EMFILE: return "too many open files";
    default: return "system error";
  }
}

}  // namespace detail

// ---------------------------------------------------------------------------------------------------------------------
// Client
// ---------------------------------------------------------------------------------------------------------------------

class Client {
 public:
  /// Allocate all memory and resolve the host's name; send nothing. If an option is wrong, every call returns `invalid`
  /// and `error` has the reason.
  explicit Client(const Options& options);
  ~Client() { close(); }
  Client(const Client&) = delete;
  Client& operator=(const Client&) = delete;

  /// Wait until the stream is open, the service refuses it (`refused`, e.g. a wrong key or name), or the deadline.
  Status connect(Deadline until);

  /// Request the torque at a motion. Returns at once if there is no connection and no attempt is due before the
  /// deadline. With `learn`, the torque is kept unless the status is `full` or `invalid`; it is sent after the torques
  /// that were kept before. In a control loop, call `ask` first, then `teach`.
  Status ask(const Query& query, Answer& answer, Deadline until);

  /// Request a part of the torque as `ask` does. If no answer arrives by the deadline, `answer` has no arrays. `refused`
  /// if the model has no such part.
  Status gravity(const double* q, Answer& answer, Deadline until, bool std = true) {
    Query query{q};
    query.kind = Kind::gravity, query.std = std;
    return ask(query, answer, until);
  }
  Status mass_matrix(const double* q, Answer& answer, Deadline until) {
    Query query{q};
    query.kind = Kind::mass_matrix;
    return ask(query, answer, until);
  }
  Status coriolis(const double* q, const double* dq, Answer& answer, Deadline until) {
    Query query{q, dq};
    query.kind = Kind::coriolis;
    return ask(query, answer, until);
  }

  /// Let the model learn from the torque measured at a motion: keep it, and send it if possible without waiting. `ok`:
  /// it is kept.
  Status teach(const Query& query);

  /// Receive, send and reconnect as far as possible without waiting. For loops that rarely call `ask`.
  void tick() { run(Deadline::now(), false, [] { return false; }); }

  /// Wait until the service has acknowledged or refused all torques that were sent to learn from.
  Status flush(Deadline until);

  /// Close the connection without waiting. Unacknowledged torques are kept; the next call connects again.
  void close();

  bool connected() const { return stage_ == Stage::open; }
  /// Number of torques that are neither acknowledged nor refused.
  std::size_t unsettled() const { return unsettled_; }
  const Hello& hello() const { return hello_; }
  const Learnt& learnt() const { return learnt_; }
  const Counters& counters() const { return counters_; }
  /// Last error; it is kept after recovery.
  const Error& error() const { return error_; }
  /// Reason of the last refusal that `Learnt::refused` counts.
  const Error& refusal() const { return refusal_; }

 private:
  using Event = detail::Inbox::Event;
  enum class Stage : std::uint8_t {
    broken,      // invalid options
    down,        // waiting for the next attempt
    connecting,  // waiting for the socket to become writable
    upgrading,   // waiting for the answer to the HTTP request
    greeting,    // waiting for the first message of the service
    open,
  };
  struct Address {
    sockaddr_storage place;
    socklen_t size;
  };
  /// Frame that waits for its answer; answers arrive in order.
  struct Flight {
    std::uint32_t sequence;
    bool taught;
    std::uint64_t place;  // position of a torque to learn from, see `head_`
  };
  struct Taught {
    std::uint32_t sequence;
    bool settled;
  };

  // options
  bool read_options(const Options& options);
  bool read_url(const char* url);
  bool look_up(const char* host, const char* port);
  bool allocate(const Options& options);
  bool wrong(const char* name, const char* value, const char* expected);

  // connection
  template <class Done>
  Status run(Deadline until, bool patient, Done done);
  void begin(std::int64_t now);
  void begin_upgrade();
  void give_up(std::int64_t now);
  Status absent() {
    if (!*error_.code) say(error_, down_, "unreachable", "not connected yet");
    return down_;
  }
  void finish_connecting();
  void read_some();
  void write_some();
  void drop(Status status, const char* code);
  void lose(const char* what, int number);
  void fail(const char* reason) { drop(Status::unreachable, "protocol", reason); }
  void drop(Status status, const char* code, const char* message) {
    detail::Text(error_.message).add(message);
    drop(status, code);
  }

  // receiving
  void take_upgrade(const std::uint8_t* data, std::size_t size);
  void take_refusal(const char* body, std::size_t size, int http);
  static const char* header(const char* head, std::size_t size, const char* name, std::size_t& length);
  void take_frames(const std::uint8_t* data, std::size_t size);
  void take_control();
  void take_text();
  void take_hello(const detail::Json& message);
  void take_learnt(const detail::Json& message);
  void take_answer();
  void take_error(const Flight& flight);

  // sending
  bool check(const Query& query);
  bool keep(const Query& query);
  void fill();
  void send_frame(const std::uint8_t* frame, std::size_t size, Flight flight);
  void send_control(detail::Opcode opcode, const std::uint8_t* payload, std::size_t size);
  void send_message(detail::Opcode opcode, const std::uint8_t* payload, std::size_t size);
  void settle(std::int64_t first, std::int64_t through);

  static void say(Error& error, Status status, const char* code, std::uint32_t sequence = 0) {
    error.status = status, error.http = 0, error.close = 0, error.sequence = sequence;
    detail::Text(error.code).add(code);
  }
  static void say(Error& error, Status status, const char* code, const char* message) {
    say(error, status, code);
    detail::Text(error.message).add(message);
  }
  /// Read code and message of a JSON error; return false if there is none.
  static bool read_error(const detail::Json& object, Error& error);

  template <class T>
  static bool make(std::unique_ptr<T[]>& array, std::size_t count) {
    array.reset(new (std::nothrow) T[count]());  // zeroed, so that its pages are mapped before the control loop
    return array != nullptr;
  }

  Stage stage_ = Stage::down;
  Status down_ = Status::unreachable;  // status of calls without a connection
  int socket_ = -1;
  std::size_t joints_ = 0, window_ = 0;
  bool learns_ = false;

  Address addresses_[8];
  std::size_t address_count_ = 0, address_ = 0;
  char host_[300] = {}, head_text_[2048] = {};  // head_text_: HTTP request that opens a stream, up to its key
  char key_[25] = {};                           // key of the handshake

  std::int64_t attempt_ns_ = 0, silence_ns_ = 0, retry_first_ns_ = 0, retry_most_ns_ = 0;
  std::int64_t attempt_until_ = 0, heard_ = 0, retry_at_ = 0, backoff_ = 0;

  std::unique_ptr<std::uint8_t[]> in_, out_, message_, frame_, kept_;
  std::size_t in_size_ = 0, out_size_ = 0, out_begin_ = 0, out_end_ = 0, message_size_ = 0, frame_bytes_ = 0;
  std::size_t frame_size_ = 0;  // bytes of the frame of `ask`; 0 if it is in the backlog
  std::size_t gathered_ = 0;   // received bytes of the answer to the HTTP request
  std::size_t head_size_ = 0;  // bytes of its headers, 0 until they are complete
  detail::Inbox inbox_;
  detail::Random random_;

  // the backlog has the frames at positions head_ … tail_ − 1; those before sent_ were sent over this connection, those
  // before sent_ever_ over any; the index in the ring buffer is the position modulo backlog_
  std::unique_ptr<Taught[]> taught_;
  std::size_t backlog_ = 0, unsettled_ = 0;
  std::uint64_t head_ = 0, sent_ = 0, sent_ever_ = 0, tail_ = 0;

  std::unique_ptr<Flight[]> flights_;  // ring buffer
  std::size_t flight_first_ = 0, flight_count_ = 0, asks_flying_ = 0;

  std::uint64_t sequence_ = 0;  // sequence of the next frame; to learn from, at most 2³² − 1
  std::uint32_t asked_ = 0;     // sequence that `ask` waits for
  bool asking_ = false, ask_unsent_ = false, answered_ = false;
  Status outcome_ = Status::ok;
  Kind kind_ = Kind::torque;  // of the query that `ask` waits for
  Answer answer_, part_;      // last answers: a torque, and another kind

  std::unique_ptr<double[]> numbers_, part_numbers_, noise_std_;
  std::unique_ptr<char[][64]> names_;
  Hello hello_;
  Learnt learnt_;
  Counters counters_;
  Error error_, refusal_;
};

// --- options ---------------------------------------------------------------------------------------------------------

inline Client::Client(const Options& options) {
  random_.seed();
  if (!read_options(options)) stage_ = Stage::broken;
}

inline bool Client::wrong(const char* name, const char* value, const char* expected) {
  say(error_, Status::invalid, "invalid");
  detail::Text(error_.message).add(name).add(" is ").add(value).add(", expected ").add(expected);
  return false;
}

inline bool Client::read_options(const Options& options) {
  if (!options.model || !*options.model) return wrong("model", "missing", "the name of a model of the service");
  if (options.joints < 1 || options.joints > 1000)
    return wrong("joints", "out of range", "1 to 1000, the number of joints of the model");
  if (options.alias && options.version) return wrong("alias", "set together with version", "only one of them");
  if (options.stream_id && (options.alias || options.version))
    return wrong("stream_id", "set together with alias or version", "neither: only the serving version learns");
  if (options.window < 1 || options.window > 1024) return wrong("window", "out of range", "1 to 1024");
  if (options.backlog < 1) return wrong("backlog", "0", "at least 1");
  attempt_ns_ = Deadline::span(options.attempt_s), silence_ns_ = Deadline::span(options.silence_s);
  retry_first_ns_ = Deadline::span(options.retry_first_s), retry_most_ns_ = Deadline::span(options.retry_most_s);
  if (!attempt_ns_ || !silence_ns_ || !retry_first_ns_ || retry_most_ns_ < retry_first_ns_)
    return wrong("attempt_s, silence_s, retry_first_s or retry_most_s", "out of range",
                 "positive seconds, and retry_most_s not below retry_first_s");

  const char* const url = options.url ? options.url : std::getenv("LIPSERVE_URL");
  if (!read_url(url && *url ? url : "http://127.0.0.1:8000")) return false;
  const char* key = options.key ? options.key : std::getenv("LIPSERVE_API_KEY");
  for (const char* letter = key ? key : ""; *letter; ++letter)
    if (*letter <= ' ' || *letter > '~')  // the message must not contain the key
      return wrong("key (or LIPSERVE_API_KEY)", "invalid: it has characters that are not allowed", "lip_…");

  detail::Text request(head_text_);
  request.add("GET /v1/models/").quoted(options.model).add("/stream");
  char separator = '?';
  const auto ask_for = [&](const char* name) -> detail::Text& {
    request.add(separator).add(name).add('=');
    separator = '&';
    return request;
  };
  if (options.version) ask_for("version").add(options.version);
  if (options.alias) ask_for("alias").quoted(options.alias);
  if (options.stream_id) ask_for("stream_id").quoted(options.stream_id);
  if (options.scale) ask_for("scale").add('1');
  if (options.payload) ask_for("payload").add('1');
  if (options.rich) ask_for("rich").add('1');
  if (options.without_gravity) ask_for("without_gravity").add('1');
  request.add(" HTTP/1.1\r\nHost: ").add(host_).add("\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n");
  if (key && *key) request.add("Authorization: Bearer ").add(key).add("\r\n");
  request.add("Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: ");
  if (request.full()) return wrong("model, alias, stream_id or key", "too long", "names of up to 64 characters");
  learns_ = options.stream_id != nullptr;
  sequence_ = options.first_sequence;
  learnt_.through = std::int64_t{options.first_sequence} - 1;
  return allocate(options);
}

inline bool Client::read_url(const char* url) {
  const auto after = [url](const char* scheme) -> const char* {
    const std::size_t size = std::strlen(scheme);
    return std::strncmp(url, scheme, size) == 0 ? url + size : nullptr;
  };
  if (const char* const path = after("unix://")) {
    sockaddr_un place{};
    place.sun_family = AF_UNIX;
    if (*path != '/') return wrong("url", url, "unix:// and an absolute path, e.g. unix:///run/lipserve.sock");
    if (std::strlen(path) >= sizeof place.sun_path) return wrong("url", url, "a shorter path (limit of the system)");
    std::strncpy(place.sun_path, path, sizeof place.sun_path - 1);
    std::memcpy(&addresses_[0].place, &place, sizeof place);
    addresses_[0].size = sizeof place;
    address_count_ = 1;
    detail::Text(host_).add("localhost");
    return true;
  }
  if (after("https://") || after("wss://"))
    return wrong("url", url, "http:// or unix://: this client has no TLS; use a proxy on this host");
  const char* authority = after("http://");
  if (!authority) authority = after("ws://");
  if (!authority) return wrong("url", url, "http://host:port or unix:///path");
  const std::size_t size = std::strcspn(authority, "/?#");
  if (authority[size] && std::strcmp(authority + size, "/") != 0) return wrong("url", url, "no path after the host");
  detail::Text(host_).add(authority, size);
  if (size == 0 || size >= sizeof host_ || std::strpbrk(host_, "@ \r\n")) return wrong("url", url, "http://host:port");
  char name[sizeof host_];
  std::memcpy(name, host_, sizeof name);
  char* const closing = *name == '[' ? std::strchr(name, ']') : nullptr;  // end of an IPv6 address
  char* const colon = std::strchr(closing ? closing : name, ':');
  if (colon) *colon = 0;
  if (closing) *closing = 0;
  return look_up(closing ? name + 1 : name, colon ? colon + 1 : "80");
}

inline bool Client::look_up(const char* host, const char* port) {
  addrinfo hints{};
  hints.ai_socktype = SOCK_STREAM;
  addrinfo* places = nullptr;
  if (const int why = getaddrinfo(host, port, &hints, &places)) {
    say(error_, Status::invalid, "unreachable");
    detail::Text message(error_.message);
    message.add("no address found for ").add(host).add(" port ").add(port).add(": ").add(gai_strerror(why));
    return false;
  }
  for (const addrinfo* each = places; each && address_count_ < 8; each = each->ai_next) {
    std::memcpy(&addresses_[address_count_].place, each->ai_addr, each->ai_addrlen);
    addresses_[address_count_++].size = each->ai_addrlen;
  }
  freeaddrinfo(places);
  return true;
}

inline bool Client::allocate(const Options& options) {
  joints_ = options.joints, window_ = options.window, backlog_ = options.backlog;
  if (!learns_) backlog_ = 1;
  frame_bytes_ = frames::request_bytes(joints_, true);
  const std::size_t longest = frames::answer_head + 8 * frames::answer_numbers(joints_) + detail::most_head;
  in_size_ = 4096 + 4 * longest;
  message_size_ = 8192 + 256 * joints_ + longest;  // the first message has the joint names
  out_size_ = sizeof head_text_ + 2 * window_ * (frame_bytes_ + detail::most_head) + 4 * detail::most_control;
  const bool made = make(in_, in_size_) && make(out_, out_size_) && make(message_, message_size_) &&
                    make(frame_, frame_bytes_) && make(kept_, backlog_ * frame_bytes_) && make(taught_, backlog_) &&
                    make(flights_, 2 * window_) && make(numbers_, frames::answer_numbers(joints_)) &&
                    make(part_numbers_, frames::answer_numbers(joints_)) &&
                    make(noise_std_, joints_) && make(names_, joints_);
  if (!made) return wrong("backlog", "too large for the memory", "fewer torques");
  inbox_.use(message_.get(), message_size_);
  hello_.noise_std = noise_std_.get();
  hello_.joint_names = names_.get();
  return true;
}

// --- public methods --------------------------------------------------------------------------------------------------

inline Status Client::connect(Deadline until) {
  if (stage_ == Stage::down) down_ = Status::unreachable, retry_at_ = 0;
  run(until, true, [this] { return stage_ == Stage::open || (stage_ == Stage::down && down_ == Status::refused); });
  return stage_ == Stage::open ? Status::ok : stage_ == Stage::broken ? Status::invalid : down_;
}

inline Status Client::ask(const Query& query, Answer& answer, Deadline until) {
  answer = Answer{};
  if (stage_ == Stage::broken || !check(query)) return Status::invalid;
  kind_ = query.kind;
  const bool learns = query.learn && kind_ == Kind::torque;
  if (learns) {
    asked_ = static_cast<std::uint32_t>(sequence_), frame_size_ = 0;
    if (!keep(query)) return error_.status;
  } else {
    asked_ = static_cast<std::uint32_t>(sequence_++);
    frame_size_ = frames::write(frame_.get(), asked_, query, joints_);
  }
  ++counters_.asked;
  asking_ = true, ask_unsent_ = !learns, answered_ = false;
  Status status = run(until, false, [this] { return answered_; });
  if (answered_) {
    status = outcome_;
    if (status == Status::ok) {
      answer = kind_ == Kind::torque ? answer_ : part_;
      answer.late |= Deadline::now().ns > until.ns;  // this thread was scheduled too late
      ++counters_.answered;
    }
  } else if (status == Status::timeout) {
    say(error_, status, "timeout", "no answer by the deadline");
    error_.sequence = asked_;
    if (kind_ == Kind::torque) answer = answer_;  // last received answer
    answer.late = true;
  }
  asking_ = ask_unsent_ = answered_ = false;
  return status;
}

inline Status Client::teach(const Query& query) {
  Query taught = query;
  taught.std = taught.external = false, taught.learn = true, taught.kind = Kind::torque;
  if (stage_ == Stage::broken || !check(taught)) return Status::invalid;
  if (!keep(taught)) return error_.status;
  tick();
  return Status::ok;
}

inline Status Client::flush(Deadline until) {
  return run(until, true, [this] { return unsettled_ == 0; });
}

inline void Client::close() {
  if (stage_ == Stage::open) {
    const std::uint8_t normal[2] = {1000 >> 8, 1000 & 255};
    send_control(detail::closing, normal, sizeof normal);
    write_some();
  }
  if (stage_ == Stage::broken || stage_ == Stage::down) return;
  if (stage_ == Stage::open) --counters_.losses;  // `drop` counts a loss, but this is none
  drop(Status::unreachable, "closed", "closed by this client");
  retry_at_ = 0, backoff_ = 0;
}

inline bool Client::check(const Query& query) {
  const double* const parts[] = {query.q, query.dq, query.ddq, query.tau};
  const std::size_t vectors = frames::vectors(query);
  for (std::size_t part = 0; part < (vectors < 3 ? vectors : 3); ++part)
    if (!parts[part]) return wrong("q, dq or ddq", "null", "one number per joint");
  if (query.kind != Kind::torque) return true;
  if (vectors == 4 && !query.tau) return wrong("tau", "null", "the torque measured at this motion");
  if (query.learn && !learns_)
    return wrong("stream_id of the options", "null", "the name of the robot or recording, which learning requires");
  return true;
}

// --- connection ------------------------------------------------------------------------------------------------------

/// Receive, send and connect until `done` or the deadline. patient: also wait between attempts to connect.
template <class Done>
Status Client::run(Deadline until, bool patient, Done done) {
  if (stage_ == Stage::broken) return Status::invalid;
  for (;;) {
    if (done()) return Status::ok;
    const std::int64_t now = Deadline::now().ns;
    if (stage_ == Stage::down && now >= retry_at_) {
      begin(now);
      if (stage_ == Stage::down) continue;
    }
    if (stage_ == Stage::down && (now >= until.ns || (!patient && retry_at_ >= until.ns))) return absent();
    if (stage_ == Stage::open) fill();
    if (stage_ >= Stage::upgrading && out_begin_ != out_end_) {
      write_some();
      if (stage_ == Stage::down) continue;  // lost
    }

    const bool last = now >= until.ns;
    std::int64_t wake = until.ns;
    if (stage_ == Stage::down && retry_at_ < wake) wake = retry_at_;
    if (stage_ >= Stage::connecting && stage_ < Stage::open && attempt_until_ < wake) wake = attempt_until_;
    if (stage_ == Stage::open && flight_count_ && heard_ + silence_ns_ < wake) wake = heard_ + silence_ns_;
    const std::int64_t wait = last || wake <= now ? 0 : wake - now;
    const bool writes = stage_ == Stage::connecting || out_begin_ != out_end_;
    pollfd watched{socket_, static_cast<short>(POLLIN | (writes ? POLLOUT : 0)), 0};
    const timespec span{static_cast<time_t>(wait / 1'000'000'000), static_cast<long>(wait % 1'000'000'000)};
    const int ready = ppoll(&watched, socket_ < 0 ? 0 : 1, &span, nullptr);
    if (ready > 0 && stage_ == Stage::connecting) finish_connecting();
    else if (ready > 0 && (watched.revents & ~POLLOUT)) read_some();
    else if (ready == 0) give_up(Deadline::now().ns);
    if (last) return done() ? Status::ok : stage_ == Stage::open ? Status::timeout : absent();
  }
}

/// Drop a connection that is silent for too long.
inline void Client::give_up(std::int64_t now) {
  if (stage_ == Stage::open && flight_count_ && now >= heard_ + silence_ns_)
    drop(Status::unreachable, "unreachable", "connection dropped: no answer within silence_s");
  else if (stage_ > Stage::down && stage_ < Stage::open && now >= attempt_until_)
    drop(Status::unreachable, "unreachable", "the service did not accept the connection within attempt_s");
}

/// Start to connect to the next address.
inline void Client::begin(std::int64_t now) {
  const Address& address = addresses_[address_++ % address_count_];
  attempt_until_ = now + attempt_ns_;
  socket_ = socket(address.place.ss_family, SOCK_STREAM, 0);
  stage_ = Stage::connecting;
  if (socket_ >= 0) {
    fcntl(socket_, F_SETFD, FD_CLOEXEC);
    fcntl(socket_, F_SETFL, fcntl(socket_, F_GETFL) | O_NONBLOCK);
    const int on = 1;
    if (address.place.ss_family != AF_UNIX) setsockopt(socket_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
#ifdef SO_NOSIGPIPE
    setsockopt(socket_, SOL_SOCKET, SO_NOSIGPIPE, &on, sizeof on);
#endif
    if (::connect(socket_, reinterpret_cast<const sockaddr*>(&address.place), address.size) == 0)
      return begin_upgrade();
    if (errno == EINPROGRESS || errno == EINTR) return;
  }
  lose("no service answers at the address", errno);
}

inline void Client::finish_connecting() {
  int why = 0;
  socklen_t size = sizeof why;
  if (getsockopt(socket_, SOL_SOCKET, SO_ERROR, &why, &size) != 0) why = errno;
  if (why == 0) return begin_upgrade();
  lose("no service answers at the address", why);
}

inline void Client::begin_upgrade() {
  std::uint8_t nonce[16];
  frames::put(frames::put(nonce, random_.next(), 8), random_.next(), 8);
  detail::base64(nonce, sizeof nonce, key_);
  const std::size_t size = std::strlen(head_text_);
  std::memcpy(out_.get(), head_text_, size);
  std::memcpy(out_.get() + size, key_, 24);
  std::memcpy(out_.get() + size + 24, "\r\n\r\n", 4);
  out_begin_ = 0, out_end_ = size + 28;
  gathered_ = head_size_ = 0;
  stage_ = Stage::upgrading;
  inbox_.reset();
}

inline void Client::lose(const char* what, int number) {
  detail::Text message(error_.message);
  message.add(what).add(" (").add(host_).add("): ").add(detail::words(number)).add(", errno ").add(number);
  drop(Status::unreachable, "unreachable");
}

/// Close the connection and schedule the next attempt; error_.message has the reason already.
inline void Client::drop(Status status, const char* code) {
  if (socket_ >= 0) ::close(socket_);
  if (stage_ == Stage::open) ++counters_.losses;
  say(error_, status, code);
  socket_ = -1, stage_ = Stage::down, down_ = status;
  retry_at_ = Deadline::now().ns + backoff_;
  backoff_ = backoff_ == 0 ? retry_first_ns_ : backoff_ * 2 < retry_most_ns_ ? backoff_ * 2 : retry_most_ns_;
  out_begin_ = out_end_ = flight_first_ = flight_count_ = asks_flying_ = 0;
  ask_unsent_ = asking_ && !answered_ && frame_size_ != 0;
}

inline void Client::read_some() {
  const ssize_t size = recv(socket_, in_.get(), in_size_, 0);
  if (size < 0) {
    if (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR) return;
    return lose("the connection was lost", errno);
  }
  if (stage_ == Stage::upgrading) return take_upgrade(in_.get(), static_cast<std::size_t>(size));
  if (size == 0) return drop(Status::unreachable, "closed", "the service closed the connection");
  take_frames(in_.get(), static_cast<std::size_t>(size));
}

inline void Client::write_some() {
  const ssize_t size = send(socket_, out_.get() + out_begin_, out_end_ - out_begin_, MSG_NOSIGNAL);
  if (size >= 0) {
    out_begin_ += static_cast<std::size_t>(size);
    if (out_begin_ == out_end_) out_begin_ = out_end_ = 0;
  } else if (errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR) {
    const int why = errno;
    read_some();  // the service may have sent a reason before it closed the connection
    if (socket_ >= 0) lose("the connection was lost", why);
  }
}

// --- receiving -------------------------------------------------------------------------------------------------------

/// Collect the answer to the HTTP request that opens a stream; size 0: end of the data.
inline void Client::take_upgrade(const std::uint8_t* data, std::size_t size) {
  // HTTP text uses the buffer of messages
  const char* const begin = reinterpret_cast<const char*>(message_.get());
  std::size_t taken = 0;
  for (; taken < size && !head_size_; ++taken) {
    if (gathered_ == message_size_) return fail("the headers of the HTTP answer are too long");
    message_[gathered_++] = data[taken];
    if (gathered_ >= 4 && std::memcmp(begin + gathered_ - 4, "\r\n\r\n", 4) == 0) head_size_ = gathered_;
  }
  if (!head_size_) {
    if (size == 0) drop(Status::unreachable, "closed", "the service closed the connection before the stream was open");
    return;
  }
  const int http = gathered_ > 12 && std::memcmp(begin, "HTTP/1.", 7) == 0 ? std::atoi(begin + 9) : 0;
  if (http != 101) {
    for (; taken < size && gathered_ < message_size_; ++taken) message_[gathered_++] = data[taken];
    std::size_t length = 0, digits = 0;
    const char* const value = header(begin, head_size_, "content-length", digits);
    for (std::size_t k = 0; value && k < digits && length < message_size_; ++k)
      length = length * 10 + static_cast<std::size_t>(value[k] - '0');
    if (size && gathered_ < message_size_ && (!value || gathered_ < head_size_ + length)) return;
    return take_refusal(begin + head_size_, gathered_ - head_size_, http);
  }
  char expected[29];
  detail::accept_of(key_, expected);
  std::size_t letters = 0;
  const char* const accept = header(begin, head_size_, "sec-websocket-accept", letters);
  const bool accepted = accept && letters == 28 && std::memcmp(accept, expected, 28) == 0;
  if (!accepted || !header(begin, head_size_, "upgrade", letters))
    return fail("the server is not a WebSocket server: wrong Sec-WebSocket-Accept");
  if (header(begin, head_size_, "sec-websocket-extensions", letters))
    return fail("the service uses a WebSocket extension that was not requested");
  stage_ = Stage::greeting;
  take_frames(data + taken, size - taken);
}

/// Return the trimmed value of a header, or null.
inline const char* Client::header(const char* head, std::size_t size, const char* name, std::size_t& length) {
  const std::size_t letters = std::strlen(name);
  for (std::size_t start = 0; start < size;) {
    std::size_t end = start;
    while (end < size && head[end] != '\r') ++end;
    std::size_t same = 0;
    while (same < letters && start + same < end && (head[start + same] | 32) == (name[same] | 32)) ++same;
    if (same == letters && start + same < end && head[start + same] == ':') {
      for (start += same + 1; start < end && head[start] == ' ';) ++start;
      while (end > start && head[end - 1] == ' ') --end;
      length = end - start;
      return head + start;
    }
    start = end + 2;
  }
  return nullptr;
}

inline void Client::take_refusal(const char* body, std::size_t size, int http) {
  Error said;
  const bool known = read_error(detail::Json(body, body + size), said);
  detail::Text message(error_.message);
  if (known) message.add(said.message);
  else if (http) message.add("the service refused the stream with HTTP status ").add(http);
  else message.add("the server at ").add(host_).add(" is not an HTTP server");
  // a service that is busy or starting may accept the connection soon
  drop(http == 429 || http >= 500 || !http ? Status::unreachable : Status::refused, known ? said.code : "refused");
  error_.http = http;
}

inline void Client::take_frames(const std::uint8_t* data, std::size_t size) {
  const std::uint8_t* const end = data + size;
  while (socket_ >= 0) {
    switch (inbox_.take(data, end)) {
      case Event::more: return;
      case Event::broken: return fail(inbox_.why);
      case Event::control: take_control(); break;
      case Event::message:
        heard_ = Deadline::now().ns;
        if (inbox_.opcode == detail::text) take_text();
        else if (stage_ == Stage::open) take_answer();
        else return fail("the service sent an answer before its first message");
    }
  }
}

inline void Client::take_control() {
  if (inbox_.opcode == detail::ping) return send_control(detail::pong, inbox_.control, inbox_.control_size);
  if (inbox_.opcode != detail::closing) return;
  const bool coded = inbox_.control_size >= 2;
  const int code = coded ? inbox_.control[0] << 8 | inbox_.control[1] : 1005;
  send_control(detail::closing, inbox_.control, coded ? 2 : 0);
  send(socket_, out_.get() + out_begin_, out_end_ - out_begin_, MSG_NOSIGNAL);  // as far as possible without waiting
  detail::Text message(error_.message);
  message.add("the service closed the stream: ");
  if (inbox_.control_size > 2) message.add(reinterpret_cast<const char*>(inbox_.control) + 2, inbox_.control_size - 2);
  else message.add("code ").add(code);
  drop(Status::unreachable, "closed");
  error_.close = code;
}

inline void Client::take_text() {
  const char* const begin = reinterpret_cast<const char*>(inbox_.data);
  const detail::Json message(begin, begin + inbox_.size);
  if (message.member("layout").there()) return take_hello(message);
  if (stage_ != Stage::open) return fail("the service's first message has no `layout`");
  if (const detail::Json learnt = message.member("learnt"); learnt.there()) return take_learnt(learnt);
  const detail::Json refused = message.member("refused");
  if (!refused.there()) return;  // message of a later release
  read_error(refused, refusal_);
  refusal_.sequence = static_cast<std::uint32_t>(refused.member("first").count());
  const std::uint64_t before = unsettled_;
  settle(refused.member("first").integer(), refused.member("through").integer());
  learnt_.refused += before - unsettled_;
}

inline void Client::take_hello(const detail::Json& message) {
  if (message.member("layout").integer() != frames::layout) {
    detail::Text(error_.message).add("the service's frame layout is not supported: use the client of its release");
    return drop(Status::refused, "layout");
  }
  std::size_t count = 0;
  message.member("joint_names").each([&](const detail::Json&, const detail::Json& name) {
    if (count < joints_) name.text(names_[count], sizeof names_[count]);
    return ++count < 10000;
  });
  if (count != joints_) {
    detail::Text message_text(error_.message);
    message_text.add("joints is ").add(joints_).add(", expected ").add(count).add(", the joints of the model");
    return drop(Status::refused, "joints");
  }
  std::size_t place = 0;
  message.member("noise_std").each([&](const detail::Json&, const detail::Json& number) {
    if (place < joints_) noise_std_[place] = number.number(0.0);
    return ++place < joints_;
  });
  hello_.version = static_cast<std::uint32_t>(message.member("version").count());
  hello_.revision = message.member("revision").count();
  hello_.max_position = message.member("max_position").number(0.0);
  message.member("torque_convention").text(hello_.torque_convention, sizeof hello_.torque_convention);
  if (stage_ == Stage::open) return;
  stage_ = Stage::open;
  sent_ = head_;  // send all unacknowledged torques again
  ++counters_.connections;
}

inline void Client::take_learnt(const detail::Json& message) {
  const detail::Json through = message.member("through");
  if (through.integer() < 0) return fail("the service sent an acknowledgement without a sequence");
  learnt_.through = through.integer();
  learnt_.accepted += message.member("accepted").count();
  learnt_.duplicates += message.member("duplicates").count();
  const std::uint64_t revision = message.member("revision").count();
  if (revision > learnt_.revision) learnt_.revision = revision;
  message.member("rejected").each([this](const detail::Json& key, const detail::Json& count) {
    char code[sizeof Learnt::Count::code];
    key.text(code, sizeof code);
    learnt_.rejected += count.count();
    for (Learnt::Count& each : learnt_.codes) {
      if (*each.code && std::strcmp(each.code, code) != 0) continue;
      std::memcpy(each.code, code, sizeof code);
      each.count += count.count();
      break;
    }
    return true;
  });
  settle(0, learnt_.through);
}

inline void Client::take_answer() {
  backoff_ = 0;
  if (inbox_.size < frames::answer_head || !flight_count_) return fail("the service sent an answer without a query");
  const Flight flight = flights_[flight_first_];
  flight_first_ = (flight_first_ + 1) % (2 * window_), --flight_count_;
  if (!flight.taught) --asks_flying_;
  const std::uint64_t flags = frames::get(inbox_.data + 4, 2);
  if (!(flags & frames::unread) && frames::get(inbox_.data, 4) != flight.sequence)
    return fail("the service sent an answer out of order");
  const bool awaited = asking_ && !answered_ && flight.sequence == asked_;
  if (flags & frames::error) {
    take_error(flight);
    outcome_ = Status::refused;
  } else {
    // if nobody waits for the answer, only its header is read
    const bool torque = kind_ == Kind::torque;
    double* const numbers = torque ? numbers_.get() : part_numbers_.get();
    if (awaited && !frames::read(inbox_.data, inbox_.size, joints_, numbers, torque ? answer_ : part_))
      return fail("the service sent an answer whose length does not match its header");
    outcome_ = Status::ok;
  }
  answered_ = answered_ || awaited;
  if (!awaited && !flight.taught) ++counters_.stale;
}

inline void Client::take_error(const Flight& flight) {
  const char* const begin = reinterpret_cast<const char*>(inbox_.data);
  Error& error = flight.taught ? refusal_ : error_;
  say(error, Status::refused, "refused", "the service rejected a query without a reason");
  read_error(detail::Json(begin + frames::answer_head, begin + inbox_.size), error);
  error.sequence = flight.sequence;
  if (!flight.taught) return;
  if (asking_ && flight.sequence == asked_) error_ = refusal_;
  if (flight.place < head_ || taught_[flight.place % backlog_].settled) return;
  ++learnt_.refused;
  settle(flight.sequence, flight.sequence);
}

inline bool Client::read_error(const detail::Json& object, Error& error) {
  const detail::Json said = object.member("error");
  say(error, Status::refused, "refused");
  if (!said.member("message").text(error.message, sizeof error.message)) return false;
  said.member("code").text(error.code, sizeof error.code);
  return true;
}

/// Remove torques with sequences first to through from the backlog: they are acknowledged or refused.
inline void Client::settle(std::int64_t first, std::int64_t through) {
  for (std::uint64_t place = head_; place < sent_ever_; ++place) {
    Taught& each = taught_[place % backlog_];
    if (std::int64_t{each.sequence} > through) break;
    if (std::int64_t{each.sequence} < first || each.settled) continue;
    each.settled = true;
    --unsettled_;
  }
  while (head_ < sent_ever_ && taught_[head_ % backlog_].settled) ++head_;
  if (sent_ < head_) sent_ = head_;
}

// --- sending ---------------------------------------------------------------------------------------------------------

/// Append a query to the backlog; return false and set the error if that is impossible.
inline bool Client::keep(const Query& query) {
  if (tail_ - head_ == backlog_) {
    say(error_, Status::full, "full");
    detail::Text(error_.message).add("the backlog is full: ").add(backlog_).add(" torques are not acknowledged yet");
    return false;
  }
  if (sequence_ > UINT32_MAX) return wrong("stream_id", "out of sequences", "a new client with another stream_id");
  const std::size_t place = tail_++ % backlog_;
  taught_[place] = {static_cast<std::uint32_t>(sequence_++), false};
  frames::write(kept_.get() + place * frame_bytes_, taught_[place].sequence, query, joints_);
  ++unsettled_, ++counters_.taught;
  return true;
}

/// Queue frames for the socket: first the query of `ask`, then torques to learn from.
inline void Client::fill() {
  if (ask_unsent_ && asks_flying_ < window_) {
    ask_unsent_ = false;
    ++asks_flying_;
    send_frame(frame_.get(), frame_size_, {asked_, false, 0});
  }
  for (; sent_ < tail_ && flight_count_ - asks_flying_ < window_; ++sent_) {
    const Taught& each = taught_[sent_ % backlog_];
    if (each.settled) continue;  // refused, while earlier torques are still open
    if (sent_ < sent_ever_) ++counters_.resent;
    else sent_ever_ = sent_ + 1;
    send_frame(kept_.get() + sent_ % backlog_ * frame_bytes_, frame_bytes_, {each.sequence, true, sent_});
  }
}

inline void Client::send_frame(const std::uint8_t* frame, std::size_t size, Flight flight) {
  if (!flight_count_) heard_ = Deadline::now().ns;  // the wait for an answer starts now
  flights_[(flight_first_ + flight_count_++) % (2 * window_)] = flight;
  send_message(detail::binary, frame, size);
}

inline void Client::send_control(detail::Opcode opcode, const std::uint8_t* payload, std::size_t size) {
  // drop control frames if the service sends pings but does not read
  const std::size_t reserved = 2 * window_ * (frame_bytes_ + detail::most_head) + 2 * detail::most_control;
  if (out_size_ - (out_end_ - out_begin_) >= reserved) send_message(opcode, payload, size);
}

/// Append a message to the output buffer; it has room for all frames that can be open.
inline void Client::send_message(detail::Opcode opcode, const std::uint8_t* payload, std::size_t size) {
  if (out_end_ + size + detail::most_head > out_size_) {
    std::memmove(out_.get(), out_.get() + out_begin_, out_end_ - out_begin_);
    out_end_ -= out_begin_, out_begin_ = 0;
  }
  out_end_ += detail::seal(out_.get() + out_end_, opcode, payload, size, static_cast<std::uint32_t>(random_.next()));
}

}  // namespace lipserve

#endif  // LIPSERVE_CLIENT_HPP
