# fastloop_module(NAME DEPS target...)
#
# One folder of src/fastloop becomes the static library fastloop_NAME (alias fastloop::NAME) and, beside it, its tests:
#   x.cpp              library source
#   x_test.cpp         test, ctest label "unit"
#   x_slow_test.cpp    test, ctest label "slow"
#   x_dataset_test.cpp test that reads data outside the repository, ctest label "dataset"
#   x.cu               library source of builds with CUDA
#   x_no_cuda.cpp      library source of builds without
# ctest names are NAME/Suite.Test.

add_library(fastloop_warnings INTERFACE)
target_compile_options(fastloop_warnings INTERFACE
                       $<$<COMPILE_LANGUAGE:CXX>:-Wall;-Wextra;-Wshadow;-Wnon-virtual-dtor;-Woverloaded-virtual>
                       $<$<COMPILE_LANG_AND_ID:CXX,GNU>:-Wno-maybe-uninitialized;-Wno-restrict>
                       $<$<COMPILE_LANGUAGE:CUDA>:-Xcompiler=-Wall;-Xcudafe=--diag_suppress=20012>)
add_library(fastloop_sanitizers INTERFACE)
# Seconds that a test may take; sanitizers slow the longest of them down more than ten times.
set(FASTLOOP_TEST_TIMEOUT 900)
set(FASTLOOP_SHORT_TEST_TIMEOUT 300)
if(FASTLOOP_SANITIZE)
  set(FASTLOOP_TEST_TIMEOUT 3600)
  set(FASTLOOP_SHORT_TEST_TIMEOUT 1200)
  target_compile_options(fastloop_sanitizers INTERFACE -fsanitize=${FASTLOOP_SANITIZE}
                         -fno-omit-frame-pointer)
  target_link_options(fastloop_sanitizers INTERFACE -fsanitize=${FASTLOOP_SANITIZE})
endif()

function(fastloop_test_executable target prefix label)
  cmake_parse_arguments(T "" "" "SOURCES;DEPS" ${ARGN})
  if(NOT T_SOURCES OR NOT FASTLOOP_BUILD_TESTS)
    return()
  endif()
  add_executable(${target} ${T_SOURCES})
  target_link_libraries(${target} PRIVATE ${T_DEPS} fastloop_warnings GTest::gtest_main GTest::gmock)
  gtest_discover_tests(${target} TEST_PREFIX "${prefix}/" DISCOVERY_TIMEOUT 60
                       PROPERTIES LABELS ${label} TIMEOUT ${FASTLOOP_TEST_TIMEOUT})
endfunction()

function(fastloop_module name)
  cmake_parse_arguments(M "" "" "DEPS;TEST_DEPS" ${ARGN})
  file(GLOB sources CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/*.cpp)
  set(all_tests ${sources})
  list(FILTER sources EXCLUDE REGEX "_test\\.cpp$")
  list(FILTER all_tests INCLUDE REGEX "_test\\.cpp$")
  if(FASTLOOP_WITH_CUDA)
    list(FILTER sources EXCLUDE REGEX "_no_cuda\\.cpp$")
    file(GLOB cuda_sources CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/*.cu)
    list(APPEND sources ${cuda_sources})
  endif()
  if(sources)
    add_library(fastloop_${name} STATIC ${sources})
    target_link_libraries(fastloop_${name} PUBLIC ${M_DEPS} fastloop_sanitizers PRIVATE fastloop_warnings)
    target_include_directories(fastloop_${name} PUBLIC ${PROJECT_SOURCE_DIR}/src)
    if(cuda_sources)
      target_link_libraries(fastloop_${name} PRIVATE CUDA::cudart_static)
    endif()
  else()
    add_library(fastloop_${name} INTERFACE)
    target_link_libraries(fastloop_${name} INTERFACE ${M_DEPS} fastloop_sanitizers)
    target_include_directories(fastloop_${name} INTERFACE ${PROJECT_SOURCE_DIR}/src)
  endif()
  add_library(fastloop::${name} ALIAS fastloop_${name})

  set(dataset_tests ${all_tests})
  set(slow_tests ${all_tests})
  list(FILTER dataset_tests INCLUDE REGEX "_dataset_test\\.cpp$")
  list(FILTER slow_tests INCLUDE REGEX "_slow_test\\.cpp$")
  list(FILTER all_tests EXCLUDE REGEX "_(dataset|slow)_test\\.cpp$")
  fastloop_test_executable(fastloop_${name}_test ${name} unit SOURCES ${all_tests} DEPS fastloop::${name} ${M_TEST_DEPS})
  fastloop_test_executable(fastloop_${name}_slow_test ${name} slow SOURCES ${slow_tests} DEPS fastloop::${name} ${M_TEST_DEPS})
  fastloop_test_executable(fastloop_${name}_dataset_test ${name} dataset SOURCES ${dataset_tests} DEPS fastloop::${name} ${M_TEST_DEPS})
endfunction()
