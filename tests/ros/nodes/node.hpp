// Shared by the two sources of the C++ test nodes.
#pragma once

#include <cstdlib>
#include <iostream>
#include <map>
#include <string>
#include <vector>

// The `--option value` pairs of the command line.
class Options {
 public:
  explicit Options(const std::vector<std::string>& words) {
    for (size_t i = 0; i + 1 < words.size(); i += 2) values_[words[i].substr(2)] = words[i + 1];
  }
  std::string text(const std::string& name, const std::string& otherwise = "") const {
    auto found = values_.find(name);
    return found == values_.end() ? otherwise : found->second;
  }
  double number(const std::string& name, double otherwise) const {
    auto found = values_.find(name);
    return found == values_.end() ? otherwise : std::atof(found->second.c_str());
  }

 private:
  std::map<std::string, std::string> values_;
};

// A line in a single write, so that lines of several threads do not mix.
inline void say(const std::string& line) { std::cout << line + "\n" << std::flush; }

void actionServer(const Options& options);
void actionClient(const Options& options);
