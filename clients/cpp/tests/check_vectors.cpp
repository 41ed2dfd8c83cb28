// SPDX-License-Identifier: Apache-2.0
//
// Checks the parts of the header against clients/stream-vectors.txt, and WebSocket messages in pieces of any size.
//     check_vectors stream-vectors.txt

#include <cstdio>
#include <fstream>
#include <lipserve/client.hpp>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace {

using Bytes = std::vector<std::uint8_t>;
using Fields = std::map<std::string, std::string>;
namespace detail = lipserve::detail;
namespace frames = lipserve::frames;

int failures = 0;
std::string context;

void check(bool holds, const char* what) {
  if (holds) return;
  ++failures;
  std::printf("FAILED %s: %s\n", context.c_str(), what);
}

#define CHECK(condition) check((condition), #condition)

Bytes bytes_of(const std::string& hex) {
  Bytes bytes;
  std::string digits;
  for (const char letter : hex)
    if (letter != ' ') digits += letter;
  for (std::size_t k = 0; k < digits.size(); k += 2)
    bytes.push_back(static_cast<std::uint8_t>(std::stoul(digits.substr(k, 2), nullptr, 16)));
  return bytes;
}

std::vector<double> numbers_of(const std::string& text) {
  std::istringstream words(text);
  std::vector<double> numbers;
  for (std::string word; words >> word;) numbers.push_back(std::strtod(word.c_str(), nullptr));
  return numbers;
}

/// Return whether two values have the same bits.
bool same(const double* seen, const std::string& text) {
  const std::vector<double> expected = numbers_of(text);
  return seen && std::memcmp(seen, expected.data(), 8 * expected.size()) == 0;
}

unsigned long whole(const Fields& fields, const char* name) { return std::stoul(fields.at(name)); }

detail::Json json_of(const Bytes& bytes, std::size_t from = 0) {
  const char* const begin = reinterpret_cast<const char*>(bytes.data());
  return {begin + from, begin + bytes.size()};
}

std::string text_of(const detail::Json& value) {
  char text[200];
  return value.text(text, sizeof text) ? text : "no string";
}

void check_request(const Fields& fields, const Bytes& bytes) {
  std::map<std::string, std::vector<double>> parts;
  for (const char* name : {"q", "dq", "ddq", "tau"})
    if (fields.count(name)) parts[name] = numbers_of(fields.at(name));
  const unsigned long flags = whole(fields, "flags");
  lipserve::Query query{parts["q"].data(), parts["dq"].data(), parts["ddq"].data()};
  if (parts.count("tau")) query.tau = parts["tau"].data();
  query.std = flags & 1, query.learn = flags & 2, query.external = flags & 4;
  query.kind = static_cast<lipserve::Kind>(flags & 56U);
  query.budget = std::strtod(fields.at("deadline").c_str(), nullptr);
  Bytes made(frames::request_bytes(2, true));
  made.resize(frames::write(made.data(), static_cast<std::uint32_t>(whole(fields, "sequence")), query, 2));
  CHECK(made == bytes);
}

void check_answer(const Fields& fields, const Bytes& bytes) {
  lipserve::Answer seen;
  std::vector<double> numbers(frames::answer_numbers(2));
  CHECK(frames::read(bytes.data(), bytes.size(), 2, numbers.data(), seen));
  CHECK(seen.sequence == whole(fields, "sequence"));
  CHECK(seen.version == whole(fields, "version"));
  CHECK(seen.late_answers == whole(fields, "late_answers"));
  CHECK(seen.revision == whole(fields, "revision"));
  CHECK(seen.late == ((whole(fields, "flags") & 2) != 0));
  CHECK(same(&seen.seconds, fields.at("seconds")));
  const std::map<std::string, const double*> arrays{{"tau", seen.tau},
                                                    {"tau_std", seen.tau_std},
                                                    {"scale", seen.scale},
                                                    {"gravity", seen.gravity},
                                                    {"gravity_std", seen.gravity_std},
                                                    {"mass_matrix", seen.mass_matrix},
                                                    {"coriolis", seen.coriolis},
                                                    {"external_tau", seen.tau_external},
                                                    {"external_std", seen.tau_external_std},
                                                    {"external_z", seen.tau_external_z}};
  for (const auto& [name, array] : arrays) {
    CHECK((array != nullptr) == (fields.count(name) == 1));
    if (array) CHECK(same(array, fields.at(name)));
  }
  if (seen.tau_external) {
    CHECK(same(&seen.external_statistic, fields.at("external_statistic")));
    CHECK(same(&seen.external_p, fields.at("external_p")));
  }
  CHECK(seen.fallback == ((whole(fields, "flags") & 128U) != 0));
  CHECK(seen.has_payload == (fields.count("payload") == 1));
  const std::vector<double> payload = numbers_of(seen.has_payload ? fields.at("payload") : "0.0 0.0");
  CHECK(seen.payload_mass == payload[0] || (seen.payload_mass != seen.payload_mass && payload[0] != payload[0]));
  CHECK(seen.payload_std == payload[1] || (seen.payload_std != seen.payload_std && payload[1] != payload[1]));
  for (std::size_t size = 0; size < bytes.size(); ++size) {  // no end is read that is not there
    const Bytes cut(bytes.begin(), bytes.begin() + static_cast<long>(size));
    CHECK(!frames::read(cut.data(), size, 2, numbers.data(), seen));
  }
  CHECK(!frames::read(bytes.data(), bytes.size(), 3, numbers.data(), seen));
}

void check_error(const Fields& fields, const Bytes& bytes) {
  lipserve::Answer seen;
  std::vector<double> numbers(frames::answer_numbers(2));
  CHECK(!frames::read(bytes.data(), bytes.size(), 2, numbers.data(), seen));
  CHECK(frames::get(bytes.data(), 4) == whole(fields, "sequence"));
  CHECK(frames::get(bytes.data() + 4, 2) == whole(fields, "flags"));
  const detail::Json error = json_of(bytes, frames::answer_head).member("error");
  CHECK(text_of(error.member("code")) == fields.at("code"));
  CHECK(text_of(error.member("message")) == fields.at("message"));
  for (std::size_t size = frames::answer_head; size < bytes.size(); ++size) {  // cut anywhere: no more than is there
    const Bytes part(bytes.begin(), bytes.begin() + static_cast<long>(size));
    const detail::Json cut = json_of(part, frames::answer_head).member("error").member("message");
    CHECK(!cut.there() || fields.at("message").rfind(text_of(cut), 0) == 0);
  }
}

void check_text(const std::string& name, const Fields& fields, const Bytes& bytes) {
  const detail::Json message = json_of(bytes).member(name.c_str());
  CHECK(message.there());
  for (const auto& [field, value] : fields) {
    if (field == "bytes") continue;
    if (field == "code" || field == "message") {
      CHECK(text_of(message.member("error").member(field.c_str())) == value);
    } else if (field == "rejected") {
      std::uint64_t sum = 0;
      message.member("rejected").each([&](const detail::Json&, const detail::Json& count) {
        sum += count.count();
        return true;
      });
      CHECK(sum == std::stoul(value));
    } else {
      CHECK(message.member(field.c_str()).count() == std::stoul(value));
    }
  }
}

/// Return an unmasked message of a server.
Bytes plain(unsigned first, const Bytes& payload) {
  Bytes frame{static_cast<std::uint8_t>(first)};
  const std::size_t size = payload.size();
  if (size < 126) {
    frame.push_back(static_cast<std::uint8_t>(size));
  } else {
    const unsigned wide = size < 65536 ? 2 : 8;
    frame.push_back(wide == 2 ? 126 : 127);
    for (unsigned k = wide; k-- > 0;) frame.push_back(static_cast<std::uint8_t>(std::uint64_t{size} >> (8 * k)));
  }
  frame.insert(frame.end(), payload.begin(), payload.end());
  return frame;
}

void check_websocket(const Fields& fields, const Bytes& bytes) {
  const Bytes payload = bytes_of(fields.at("payload")), mask = bytes_of(fields.at("mask"));
  Bytes made(payload.size() + detail::most_head);
  made.resize(detail::seal(made.data(), static_cast<detail::Opcode>(whole(fields, "opcode")), payload.data(),
                           payload.size(), static_cast<std::uint32_t>(frames::get(mask.data(), 4))));
  CHECK(made == bytes);
}

void check_vector(const std::string& kind, const std::string& name, const Fields& fields) {
  context = kind + " " + name;
  const Bytes bytes = bytes_of(fields.at("bytes"));
  if (kind == "request") {
    check_request(fields, bytes);
  } else if (kind == "answer") {
    check_answer(fields, bytes);
  } else if (kind == "error") {
    check_error(fields, bytes);
  } else if (kind == "text") {
    check_text(name, fields, bytes);
  } else if (kind == "websocket") {
    check_websocket(fields, bytes);
  } else if (kind == "handshake") {
    char made[29];
    detail::accept_of(fields.at("key").c_str(), made);
    CHECK(Bytes(made, made + 28) == bytes);
  } else {
    check(false, "a kind that is known");
  }
}

int check_vectors(const char* path) {
  std::ifstream file(path);
  int count = 0;
  std::string kind, name;
  Fields fields;
  for (std::string line; std::getline(file, line);) {
    if (line.empty() || line[0] == '#') continue;
    const std::size_t start = line[0] == ' ' ? 2 : 0, space = line.find(' ', start);
    const std::string word = line.substr(start, space - start), rest = space == line.npos ? "" : line.substr(space + 1);
    if (start == 0) {
      kind = word, name = rest;
      fields.clear();
      continue;
    }
    fields[word] = rest;
    if (word == "bytes") check_vector(kind, name, fields), ++count;
  }
  return count;
}

/// Check whole and fragmented messages with control frames between them, read in pieces of any size.
void check_inbox() {
  const Bytes small(5, 's'), middle(300, 'm'), large(70000, 'l');
  Bytes stream;
  const auto append = [&stream](const Bytes& frame) { stream.insert(stream.end(), frame.begin(), frame.end()); };
  append(plain(0x82, small));
  append(plain(0x01, small));   // a text in three parts
  append(plain(0x89, small));   // a ping between
  append(plain(0x00, middle));
  append(plain(0x80, {}));
  append(plain(0x82, large));   // more than the buffer holds
  append(plain(0x81, small));
  append(plain(0x88, {0x03, 0xE8}));
  for (const std::size_t step : {1U, 2U, 3U, 7U, 126U, 4096U, 100000U}) {
    context = "inbox in steps of " + std::to_string(step);
    Bytes buffer(400);
    detail::Inbox inbox;
    inbox.use(buffer.data(), buffer.size());
    std::string seen;
    for (std::size_t from = 0; from < stream.size(); from += step) {
      const Bytes part(stream.begin() + static_cast<long>(from),
                       stream.begin() + static_cast<long>(std::min(from + step, stream.size())));
      const std::uint8_t* at = part.data();
      for (bool more = true; more;) {
        switch (inbox.take(at, part.data() + part.size())) {
          case detail::Inbox::Event::more: more = false; break;
          case detail::Inbox::Event::broken: seen += std::string("broken ") + inbox.why, more = false; break;
          case detail::Inbox::Event::control:
            seen += "control " + std::to_string(inbox.opcode) + "/" + std::to_string(inbox.control_size) + " ";
            break;
          case detail::Inbox::Event::message:
            seen += "message " + std::to_string(inbox.opcode) + "/" + std::to_string(inbox.length) + "/" +
                    std::to_string(inbox.size) + " ";
            CHECK(inbox.data[0] == (inbox.length > 1000 ? 'l' : 's'));
        }
      }
    }
    CHECK(seen == "message 2/5/5 control 9/5 message 1/305/305 message 2/70000/400 message 1/5/5 control 8/2 ");
  }
  const std::vector<std::pair<const char*, Bytes>> broken{
      {"masked", {0x82, 0x81, 1, 2, 3, 4, 5}},
      {"extension", {0xC2, 0x01, 0}},
      {"unknown kind", {0x83, 0x01, 0}},
      {"unknown control", {0x8B, 0x00}},
      {"long control", {0x89, 126, 0, 126}},
      {"control in parts", {0x09, 0x00}},
      {"continued from nothing", {0x80, 0x01, 0}},
      {"begun twice", {0x02, 0x01, 0, 0x82, 0x01, 0}},
      {"64 bits", {0x82, 127, 0x80, 0, 0, 0, 0, 0, 0, 0}},
  };
  for (const auto& [name, bytes] : broken) {
    context = std::string("inbox, ") + name;
    Bytes buffer(16);
    detail::Inbox inbox;
    inbox.use(buffer.data(), buffer.size());
    const std::uint8_t* at = bytes.data();
    CHECK(inbox.take(at, bytes.data() + bytes.size()) == detail::Inbox::Event::broken);
  }
}

void check_json() {
  context = "json";
  const std::string text =
      R"( {"a\"b" : [1, -2.5e3 ,{"x":[]}], "n":0.012707945143231912, "e":1E+2, )"
      R"("s":"\u00e9\ud83e\udd16\n\/", "last":true} )";
  const detail::Json json(text.data(), text.data() + text.size());
  std::vector<double> numbers;
  json.member("a\"b").each([&](const detail::Json& key, const detail::Json& value) {
    CHECK(!key.there());
    numbers.push_back(value.number(7.0));
    return true;
  });
  CHECK((numbers == std::vector<double>{1.0, -2500.0, 7.0}));
  const double exact = 0.012707945143231912, read = json.member("n").number(0.0);
  CHECK(std::abs(read - exact) <= 1e-16 * exact);
  CHECK(json.member("e").number(0.0) == 100.0);
  CHECK(text_of(json.member("s")) == "é🤖\n/");
  CHECK(json.member("last").there());
  CHECK(!json.member("missing").there());
  CHECK(json.member("last").integer() == -1);
  const std::vector<char> odd{'"', '\\', '\0', '\\', 't', '"'};
  CHECK(text_of(detail::Json(odd.data(), odd.data() + odd.size())).empty());  // as it is cut at the 0
  char small[4];
  const std::string word = "\"aéé\"";
  CHECK(detail::Json(word.data(), word.data() + word.size()).text(small, sizeof small));
  CHECK(std::string(small) == "aé");  // no half of a character
  for (std::size_t size = 0; size <= text.size(); ++size) {  // nothing is read beyond a cut; sanitizers would say so
    const std::vector<char> cut(text.begin(), text.begin() + static_cast<long>(size));
    text_of(detail::Json(cut.data(), cut.data() + cut.size()).member("s"));
    detail::Json(cut.data(), cut.data() + cut.size()).member("e").number(0.0);
  }
}

void check_sha1() {
  context = "sha1";
  std::uint8_t digest[20];
  for (const auto& [size, expected] : std::map<std::size_t, const char*>{
           {0, "da39a3ee5e6b4b0d3255bfef95601890afd80709"},   {55, "c1c8bbdc22796e28c0e15163d20899b65621d65a"},
           {56, "c2db330f6083854c99d4b5bfb6e8f29f201be699"},  {64, "0098ba824b5c16427bd7a1122a5a442a25ec644d"},
           {1000, "291e9a6c66994949b57ba5e650361e98fc36b1ba"}}) {
    const Bytes letters(size, 'a');
    detail::sha1(letters.data(), size, digest);
    CHECK(Bytes(digest, digest + 20) == bytes_of(expected));
  }
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2) return std::puts("usage: check_vectors stream-vectors.txt"), 2;
  const int vectors = check_vectors(arguments[1]);
  check_inbox();
  check_json();
  check_sha1();
  std::printf("%d vectors, %d failures\n", vectors, failures);
  return failures == 0 && vectors > 0 ? 0 : 1;
}
