# The proxy's image:     docker build --target proxy -t rosproxy .
# The operator's image:  docker build --target operator -t rosproxy-operator .
# `make image` builds both, with the project's version as tag.
# Any base with Debian's packages will do; where it has no Python, Debian's is installed. The digest is
# what is built on, for all platforms; `docker buildx imagetools inspect` on the tag tells the newest.
ARG BASE_IMAGE=python:3.12-slim-bookworm@sha256:782412e85d0f0984994c290652577d4018aff08145c85b262bb63dc0c7522254

FROM ${BASE_IMAGE} AS base
ENV PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1
RUN if ! command -v python3 >/dev/null; then \
      apt-get update \
      && apt-get install -y --no-install-recommends python3 \
      && rm -rf /var/lib/apt/lists/* /var/cache/apt/*; \
    fi
# No program here changes its user or group (su, mount, passwd…): whoever breaks in finds none.
RUN find / -xdev -perm /6000 -type f -exec chmod a-s {} +


FROM base AS builder
RUN apt-get update \
    && apt-get install -y --no-install-recommends binutils \
    && if ! python3 -c 'import ensurepip' 2>/dev/null; then \
      apt-get install -y --no-install-recommends python3-venv ca-certificates; \
    fi
# Two environments: one with pip, that stays here, and the one that is shipped.
RUN python3 -m venv /opt/build && python3 -m venv --without-pip /opt/rosproxy
WORKDIR /src
# Of what others made only wheels are taken, and only those whose hashes are in constraints.txt. What
# builds rosproxy stays here, with pip.
ENV PIP_NO_CACHE_DIR=1
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY scripts/pins.py scripts/
RUN python3 scripts/pins.py build-system > pins.txt \
    && /opt/build/bin/pip install --only-binary :all: --require-hashes --requirement pins.txt


FROM builder AS proxy-builder
# Extras to install besides the proxy itself, for example: --build-arg EXTRAS=zenoh,uvloop
# zenoh is the library of the routers for rmw_zenoh, 20 MB: without rmw_zenoh, --build-arg EXTRAS=
ARG EXTRAS=zenoh
RUN python3 scripts/pins.py "$EXTRAS" > pins.txt \
    && /opt/build/bin/pip --python /opt/rosproxy/bin/python install --compile \
         --only-binary :all: --require-hashes --requirement pins.txt
# Without operator/: a change of the operator makes no other proxy image, so it replaces no
# proxy. What is left of it is the name of a program.
COPY proxy proxy
RUN /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir /wheels . \
    && /opt/build/bin/pip --python /opt/rosproxy/bin/python install --compile --no-deps /wheels/*.whl \
    && rm /opt/rosproxy/bin/rosproxy-operator
# rich needs these to colour source code and to show Markdown, and we show neither: 11 MB. What the
# wheels' libraries have for debuggers is 8 MB.
RUN /opt/build/bin/pip --python /opt/rosproxy/bin/python uninstall --yes \
      pygments markdown-it-py mdurl \
    && find /opt/rosproxy -name '*.so' -exec strip --strip-unneeded {} +


FROM base AS proxy
LABEL org.opencontainers.image.title="rosproxy" \
      org.opencontainers.image.description="A transparent proxy between isolated networks for ROS 1 and ROS 2" \
      org.opencontainers.image.licenses="Apache-2.0"
# For --data-plane kernel. A container that is given NET_ADMIN does not thereby give it to a user
# that is not root: these copies have it as a file capability, for the proxy's group alone. Without
# NET_ADMIN, and with no-new-privileges, they may do nothing and the proxy forwards by itself.
RUN apt-get update \
    && apt-get install -y --no-install-recommends nftables conntrack libcap2-bin \
    && install -D --mode=0750 --group=10001 --target-directory=/usr/libexec/rosproxy \
         /usr/sbin/nft /usr/sbin/conntrack \
    && setcap cap_net_admin=ep /usr/libexec/rosproxy/nft \
              cap_net_admin=ep /usr/libexec/rosproxy/conntrack \
    && apt-get purge -y libcap2-bin \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
COPY --from=proxy-builder /opt/rosproxy /opt/rosproxy
# It speaks no TLS. aiohttp loads all CAs' certificates nevertheless, a tenth of a second at each start.
ENV PATH=/opt/rosproxy/bin:$PATH \
    SSL_CERT_FILE=/dev/null
# A number, so that Kubernetes can check runAsNonRoot. The proxy writes no file at all: it runs with
# --read-only, --cap-drop ALL and, but for the kernel plane, --security-opt no-new-privileges.
USER 10001:10001
WORKDIR /
# 11311: the master as nodes inside see it; needs no publishing.
# 11000-11099: the ports of the nodes inside; publish them 1:1 (-p 11000-11099:11000-11099).
EXPOSE 11311/tcp 11000-11099/tcp
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s --retries=3 CMD ["rosproxy", "health"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["rosproxy"]
CMD ["run"]


FROM builder AS operator-builder
# Which engines: docker, kubernetes, or operator for both.
ARG OPERATOR_EXTRAS=operator
RUN python3 scripts/pins.py "$OPERATOR_EXTRAS" > pins.txt \
    && /opt/build/bin/pip --python /opt/rosproxy/bin/python install --compile \
         --only-binary :all: --require-hashes --requirement pins.txt
COPY proxy proxy
COPY operator operator
RUN /opt/build/bin/pip wheel --no-deps --no-build-isolation --wheel-dir /wheels . \
    && /opt/build/bin/pip --python /opt/rosproxy/bin/python install --compile --no-deps /wheels/*.whl
# Neither needs the asyncio edition of the Kubernetes client, 68 MB, nor what the proxy goes without.
RUN rm -rf /opt/rosproxy/lib/python3*/site-packages/kubernetes/aio \
    && /opt/build/bin/pip --python /opt/rosproxy/bin/python uninstall --yes \
         pygments markdown-it-py mdurl \
    && find /opt/rosproxy -name '*.so' -exec strip --strip-unneeded {} +


FROM base AS operator
LABEL org.opencontainers.image.title="rosproxy-operator" \
      org.opencontainers.image.description="Runs rosproxy for labelled containers and pods" \
      org.opencontainers.image.licenses="Apache-2.0"
COPY --from=operator-builder /opt/rosproxy /opt/rosproxy
ENV PATH=/opt/rosproxy/bin:$PATH
# A number, as above. It writes no file at all; the key of the admission webhook is served from
# memory. The operator for Docker opens no port but its own health check, on loopback. The engine's
# socket belongs to root: who mounts it runs this as 0:0, still without any capability
# (examples/docker), or puts a socket proxy between. In Kubernetes the command is `kubernetes`.
USER 10001:10001
WORKDIR /
HEALTHCHECK --interval=10s --timeout=5s --start-period=10s --retries=3 CMD ["rosproxy-operator", "health"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["rosproxy-operator"]
CMD ["docker"]
