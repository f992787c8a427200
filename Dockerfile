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

# rclpy and the messages are ROS's own here, not the wheels'; they are built against NumPy 1
RUN python3 -m venv --system-site-packages "$VIRTUAL_ENV" \
 && python3 -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb')); \
e = p['project']['optional-dependencies']; \
print(*(r for r in p['project']['dependencies'] + e['fast'] + p['build-system']['requires'] if not r.startswith('ros-')), 'numpy<2', sep='\n')" > /tmp/needed.txt \
 && pip install --no-cache-dir -r /tmp/needed.txt \
 && pip install --no-cache-dir --no-deps --no-build-isolation . \
 && bash -c ". /opt/ros/jazzy/setup.bash && python -c 'from livedeform.kernels import compile_kernels; compile_kernels()'"

WORKDIR /data
CMD ["livedeform", "doctor"]
