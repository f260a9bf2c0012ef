"""The controller and the plant as a C++ library without torch: structs with units, source, tests, an example."""
