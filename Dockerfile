# The command line and both nodes on ROS 2 Jazzy: docker build -t parallel_cal .
FROM ros:jazzy

RUN apt-get update \
 && apt-get install -y --no-install-recommends python3-pip \
 && rm -rf /var/lib/apt/lists/*
RUN pip install --break-system-packages casadi lazy_loader mcap plotly 'pydantic>=2.6' rich rosbags \
    threadpoolctl typer

COPY . /workspace/src/parallel_cal
WORKDIR /workspace
RUN . /opt/ros/jazzy/setup.sh \
 && apt-get update && rosdep update \
 && rosdep install -y --ignore-src --from-paths src/parallel_cal src/parallel_cal/msg_defs \
 && colcon build --base-paths src/parallel_cal src/parallel_cal/msg_defs \
 && rm -rf /var/lib/apt/lists/* build log

ENTRYPOINT ["/bin/bash", "-c", ". /workspace/install/setup.sh && exec \"$@\"", "--"]
CMD ["ros2", "launch", "parallel_cal", "calibration.launch.py"]
