# livedeform beside ROS 2 Jazzy: Ubuntu 24.04 with its own rclpy, and everything else by pip into one environment.
#   docker build -t livedeform .
#   docker run --rm -it --network host -v "$PWD:/data" livedeform livedeform doctor
FROM ros:jazzy-ros-base

RUN apt-get update \
 && apt-get install -y --no-install-recommends python3-venv libgl1 libgomp1 \
 && rm -rf /var/lib/apt/lists/*

ENV VIRTUAL_ENV=/opt/livedeform PATH=/opt/livedeform/bin:$PATH NUMBA_CACHE_DIR=/opt/livedeform/kernels
WORKDIR /src
COPY . .

# rclpy and the messages are ROS's own here, not the wheels'; they are built against NumPy 1, and so is all that runs with
# them. OpenCV asks for NumPy 2 but runs with either, so it comes without what it asks for.
RUN python3 -m venv --system-site-packages "$VIRTUAL_ENV" \
 && python3 .ci/beside_ros.py > /tmp/needed.txt \
 && pip install --no-cache-dir -r /tmp/needed.txt \
 && pip install --no-cache-dir --no-deps "$(grep -o '^opencv-python-headless==[0-9.]*' requirements.lock)" \
 && pip install --no-cache-dir --no-deps --no-build-isolation . \
 && bash -c ". /opt/ros/jazzy/setup.bash && python -c 'from livedeform.kernels import compile_kernels; compile_kernels()'"

WORKDIR /data
CMD ["livedeform", "doctor"]
