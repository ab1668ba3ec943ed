# Checks and installs @robot@.hpp for find_package(@robot@): target parallel_cal::@robot@.
cmake_minimum_required(VERSION 3.16)
project(@robot@ LANGUAGES CXX)
include(GNUInstallDirs)
include(CTest)

add_library(@robot@ INTERFACE)
add_library(parallel_cal::@robot@ ALIAS @robot@)
target_compile_features(@robot@ INTERFACE cxx_std_17)
target_include_directories(@robot@ INTERFACE
  $<BUILD_INTERFACE:${CMAKE_CURRENT_SOURCE_DIR}> $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)

if(BUILD_TESTING)
  add_executable(@robot@_check @robot@_check.cpp)
  target_link_libraries(@robot@_check PRIVATE @robot@)
  add_test(NAME check COMMAND @robot@_check ${CMAKE_CURRENT_SOURCE_DIR}/@robot@_vectors.csv)
endif()

install(FILES @robot@.hpp DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})
install(TARGETS @robot@ EXPORT @robot@Targets)
install(EXPORT @robot@Targets NAMESPACE parallel_cal:: FILE @robot@Config.cmake
  DESTINATION ${CMAKE_INSTALL_LIBDIR}/cmake/@robot@)
