# find_package(semidense) gives the target semidense::semidense: the shared library with its headers.
#
#     find_package(semidense REQUIRED)
#     target_link_libraries(my_robot PRIVATE semidense::semidense)
include(FindPackageHandleStandardArgs)

find_path(semidense_INCLUDE_DIR semidense.h HINTS "${CMAKE_CURRENT_LIST_DIR}/../../../../include" "${CMAKE_CURRENT_LIST_DIR}/../../../include")
find_library(semidense_LIBRARY semidense HINTS "${CMAKE_CURRENT_LIST_DIR}/../..")
find_package_handle_standard_args(semidense REQUIRED_VARS semidense_LIBRARY semidense_INCLUDE_DIR)

if(semidense_FOUND AND NOT TARGET semidense::semidense)
    add_library(semidense::semidense SHARED IMPORTED)
    set_target_properties(semidense::semidense PROPERTIES
        IMPORTED_LOCATION "${semidense_LIBRARY}"
        INTERFACE_INCLUDE_DIRECTORIES "${semidense_INCLUDE_DIR}")
endif()
mark_as_advanced(semidense_INCLUDE_DIR semidense_LIBRARY)
