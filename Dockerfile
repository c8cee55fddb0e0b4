# hyrl-mj for machines without anything: it trains, renders without a screen, and exports.
#
#   docker build --build-arg PIP_EXTRA_INDEX_URL=... -t hyrl-mj .
#   docker run --rm -v "$PWD":/work hyrl-mj run vehicle --eps 0.1    # into runs/ of the current folder
#
# Without an index of torch's CPU builds, its package of PyPI brings several gigabytes of CUDA libraries.
FROM debian:bookworm-slim
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3 python3-venv libegl1 libopengl0 libgl1-mesa-dri \
 && rm -rf /var/lib/apt/lists/*
ARG PIP_EXTRA_INDEX_URL
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY hyrl_mj hyrl_mj
COPY models models
RUN python3 -m venv /venv && /venv/bin/pip install --no-cache-dir ".[onnx]"
ENV PATH=/venv/bin:$PATH MUJOCO_GL=egl
WORKDIR /work
ENTRYPOINT ["hyrl-mj"]
