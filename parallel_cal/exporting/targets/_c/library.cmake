# Builds, checks and installs @robot@ for find_package(@robot@): target parallel_cal::@robot@.
cmake_minimum_required(VERSION 3.16)
project(@robot@ LANGUAGES C)
include(GNUInstallDirs)
include(CTest)

find_library(MATH_LIBRARY m)
add_library(@robot@ @robot@.c)
add_library(parallel_cal::@robot@ ALIAS @robot@)
set_target_properties(@robot@ PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF POSITION_INDEPENDENT_CODE ON
  PUBLIC_HEADER @robot@.h)
target_include_directories(@robot@ PUBLIC
  $<BUILD_INTERFACE:${CMAKE_CURRENT_SOURCE_DIR}> $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
if(MATH_LIBRARY)
  target_link_libraries(@robot@ PUBLIC m)
endif()

if(BUILD_TESTING)
  foreach(program check loop)
    add_executable(@robot@_${program} @robot@_${program}.c)
    target_link_libraries(@robot@_${program} PRIVATE @robot@)
  endforeach()
  add_test(NAME check COMMAND @robot@_check ${CMAKE_CURRENT_SOURCE_DIR}/@robot@_vectors.csv)
  add_test(NAME loop COMMAND @robot@_loop)
endif()

install(TARGETS @robot@ EXPORT @robot@Targets PUBLIC_HEADER DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})
install(EXPORT @robot@Targets NAMESPACE parallel_cal:: FILE @robot@Config.cmake
  DESTINATION ${CMAKE_INSTALL_LIBDIR}/cmake/@robot@)
