# A machine with ROS 1, from Debian's packages, and with the test nodes of tests/ros in both
# languages: the nodes inside and the robot outside. The context is tests/ros/nodes.
ARG BASE_IMAGE
FROM ${BASE_IMAGE} AS ros
RUN apt-get update \
    && apt-get install -y --no-install-recommends ros-base libactionlib1d iproute2 \
      python3-actionlib python3-topic-tools \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
ENV ROS_LOG_DIR=/tmp/ros PYTHONUNBUFFERED=1

FROM ${BASE_IMAGE} AS compiler
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ pkg-config \
      libroscpp-dev libstd-msgs-dev libactionlib-dev libtopic-tools-dev \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
COPY *.cpp *.hpp /src/
RUN packages="roscpp std_msgs actionlib topic_tools" \
    && g++ -std=c++17 -O1 -w -DBOOST_BIND_GLOBAL_PLACEHOLDERS -o /src/node /src/*.cpp \
      $(pkg-config --cflags --libs $packages)

FROM ros
COPY node.py /nodes/node.py
COPY --from=compiler /src/node /nodes/node
