// SPDX-License-Identifier: Apache-2.0
//
// Fuzzer of the messages of a service. Compile it with Clang and -fsanitize=fuzzer,address,undefined.

#include <lipserve/client.hpp>
#include <vector>

namespace {

namespace detail = lipserve::detail;
using Bytes = std::vector<std::uint8_t>;  // exact size, so that reads beyond the end are detected

void read_messages(const std::uint8_t* data, std::size_t size) {
  Bytes buffer(64);
  detail::Inbox inbox;
  inbox.use(buffer.data(), buffer.size());
  for (const Bytes& part : {Bytes(data, data + size / 2), Bytes(data + size / 2, data + size)}) {
    const std::uint8_t* at = part.data();
    for (auto event = detail::Inbox::Event::message;
         event != detail::Inbox::Event::more && event != detail::Inbox::Event::broken;)
      event = inbox.take(at, part.data() + part.size());
  }
}

void read_json(const Bytes& bytes) {
  const char* const begin = reinterpret_cast<const char*>(bytes.data());
  const detail::Json json(begin, begin + bytes.size());
  char text[16];
  for (const char* name : {"learnt", "error", "joint_names"}) {
    const detail::Json value = json.member(name);
    value.text(text, sizeof text);
    value.member("message").text(text, sizeof text);
    value.each([&](const detail::Json& key, const detail::Json& each) {
      key.text(text, sizeof text);
      each.count();
      return each.number(1.0) < 1e6;
    });
  }
}

void read_answer(const Bytes& bytes) {
  lipserve::Answer answer;
  std::vector<double> numbers(lipserve::frames::answer_numbers(2));
  lipserve::frames::read(bytes.data(), bytes.size(), 2, numbers.data(), answer);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  const Bytes bytes(data, data + size);
  read_messages(data, size);
  read_json(bytes);
  read_answer(bytes);
  return 0;
}
