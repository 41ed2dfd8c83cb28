// Stub of pluginlib: makes the class known to the program that drives it.
#pragma once

#include <memory>

#define PLUGINLIB_EXPORT_CLASS(Class, Base) \
  std::unique_ptr<Base> make_plugin() { return std::make_unique<Class>(); }
