cmake_minimum_required(VERSION 3.16)
project(@package@ LANGUAGES CXX)

if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
  set(CMAKE_BUILD_TYPE Release)
endif()
add_compile_options(-Wall -Wextra -Wpedantic)

find_package(ament_cmake REQUIRED)
@find_packages@

add_library(@package@ SHARED src/plugin.cpp)
target_compile_features(@package@ PUBLIC cxx_std_17)
target_include_directories(@package@ PUBLIC
  $<BUILD_INTERFACE:${CMAKE_CURRENT_SOURCE_DIR}/include>
  $<INSTALL_INTERFACE:include/@package@>)
target_link_libraries(@package@ PUBLIC @libraries@)
pluginlib_export_plugin_description_file(@base_package@ plugin.xml)

# ros2 run @package@ self_test
add_executable(self_test test/self_test.cpp)
target_link_libraries(self_test @package@)

install(DIRECTORY include/ DESTINATION include/@package@)
install(TARGETS @package@ EXPORT export_@package@
  ARCHIVE DESTINATION lib LIBRARY DESTINATION lib RUNTIME DESTINATION bin)
install(TARGETS self_test DESTINATION lib/@package@)
install(FILES test/configurations.csv DESTINATION share/@package@)

# The self-test loads the installed plug-in: build and install first, as colcon test does.
if(BUILD_TESTING)
  find_package(ament_cmake_test REQUIRED)
  ament_add_test(self_test
    GENERATE_RESULT_FOR_RETURN_CODE_ZERO
    COMMAND $<TARGET_FILE:self_test> ${CMAKE_CURRENT_SOURCE_DIR}/test/configurations.csv)
endif()

ament_export_targets(export_@package@ HAS_LIBRARY_TARGET)
ament_export_dependencies(@dependencies@)
ament_package()
