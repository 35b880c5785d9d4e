# styleexp on the CPU, with OpenGL, the studio, maps and reports:
#   docker build -t styleexp .
#   docker run --rm -v "$PWD:/work" styleexp my.obj her.ply
FROM python:3.11-slim-bookworm

RUN apt-get update -qq \
    && apt-get install -qq --no-install-recommends libegl1 libgl1 libopengl0 libgl1-mesa-dri libosmesa6 \
    && rm -rf /var/lib/apt/lists/*

# The CPU's build of torch is a tenth of the default one, which brings CUDA.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
COPY constraints.txt /tmp/
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt --extra-index-url "$TORCH_INDEX" torch

COPY pyproject.toml README.md LICENSE /src/
COPY src /src/src
COPY conf /src/conf
COPY reports /src/reports
RUN pip install --no-cache-dir --constraint /tmp/constraints.txt '/src[gl,studio,exr,report]' \
    && rm -rf /src

# The encoder that measures results, so that the container needs no network.
ENV STYLEEXP_CACHE=/opt/styleexp
RUN styleexp-assets fetch vgg16

ENV OMP_WAIT_POLICY=PASSIVE
WORKDIR /work
ENTRYPOINT ["styleexp"]
