# A machine with sessions of zenoh that have the defaults of rmw_zenoh: those of Kilted's version,
# from PyPI, and the nodes of tests/zenoh. The context is tests/zenoh.
ARG BASE_IMAGE
FROM ${BASE_IMAGE}
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv iproute2 \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
COPY environments/1.6.2.txt /environments/
RUN python3 -m venv /opt/zenoh \
    && /opt/zenoh/bin/pip install --quiet --no-cache-dir --disable-pip-version-check \
         --only-binary :all: --no-deps --require-hashes --requirement /environments/1.6.2.txt
COPY nodes /nodes
# As rmw_zenoh's router is called.
RUN printf '#!/bin/sh\nexec python /nodes/router.py\n' > /usr/local/bin/rmw_zenohd \
    && chmod +x /usr/local/bin/rmw_zenohd
ENV PYTHONUNBUFFERED=1 PATH=/opt/zenoh/bin:$PATH \
    ROS_DISTRO=kilted RMW_IMPLEMENTATION=rmw_zenoh_cpp
