// Prints the instruction sets of this processor as a CMake list: what CLEAR_ISAS=native compiles for.
#include <iostream>

#include "isa.hpp"

int main() {
  const char* separator = "";
  for (const std::string& name : clear::instruction_sets()) {
    std::cout << separator << name;
    separator = ";";
  }
}
