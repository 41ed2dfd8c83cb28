// A motion that stubs play, and the commands that they receive: rows of numbers in the files MOTION and COMMANDS.
#ifndef STUB_RECORDING_HPP
#define STUB_RECORDING_HPP

#include <cstddef>
#include <cstdlib>
#include <fstream>
#include <iomanip>
#include <sstream>
#include <string>
#include <vector>

namespace stub {

inline std::vector<std::vector<double>> motion() {
  std::ifstream file(std::getenv("MOTION"));
  std::vector<std::vector<double>> rows;
  for (std::string line; std::getline(file, line);) {
    std::istringstream words(line);
    rows.emplace_back();
    for (std::string word; words >> word;) rows.back().push_back(std::strtod(word.c_str(), nullptr));
  }
  return rows;
}

template <class Values>
void command(const Values& values, std::size_t count) {
  static std::ofstream file(std::getenv("COMMANDS"));
  for (std::size_t j = 0; j < count; ++j) file << std::setprecision(17) << values[j] << (j + 1 < count ? ' ' : '\n');
  file.flush();
}

}  // namespace stub

#endif
