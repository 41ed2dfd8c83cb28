# The image of services and workers: no robot descriptions, no C compiler, no CUDA.
FROM python:3.11-slim AS build
WORKDIR /src
RUN python -m venv /opt/lipserve
COPY .ci/install-torch .ci/install-torch
RUN .ci/install-torch /opt/lipserve/bin/python
COPY pyproject.toml README.md LICENSE ./
COPY clients/python clients/python
COPY lipcore lipcore
COPY service service
COPY docs docs
COPY models/panda-sim models/panda-sim
RUN /opt/lipserve/bin/python -m pip install --no-cache-dir --disable-pip-version-check ./clients/python '.[cluster,grpc,signing]' \
    && /opt/lipserve/bin/python -m pip uninstall --yes --quiet setuptools pip \
    && site=$(echo /opt/lipserve/lib/python3*/site-packages) \
    && rm -rf "$site"/torch/include "$site"/torch/share "$site"/torch/test \
    && find "$site"/plotly -mindepth 1 -maxdepth 1 ! -name package_data ! -name __init__.py -exec rm -rf {} + \
    && find "$site"/botocore/data -mindepth 1 -maxdepth 1 -type d ! -name s3 ! -name sts ! -name 'sso*' ! -name signin \
        -exec rm -rf {} + \
    && find /opt/lipserve -name __pycache__ -prune -exec rm -rf {} + \
    && find "$site"/numpy "$site"/scipy "$site"/sympy "$site"/networkx "$site"/dask \
        "$site"/distributed -type d -name tests -prune -exec rm -rf {} + \
    && cd / && NUMBA_CACHE_DIR=/opt/numba /opt/lipserve/bin/python -m lipcore.warm_up \
    && /opt/lipserve/bin/python -c "import service.cli.serve, service.cli.worker, service.oip.rpc.listening, lipserve.sync, distributed, s3fs, psycopg"
# the last two also leave the bytecode of what a start imports, 50 MB: the container's user cannot write it, and without
# it every start takes four seconds longer

FROM python:3.11-slim
# Pinocchio's OpenMP runtime, which slim images lack
RUN apt-get update && apt-get install --yes --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
RUN useradd --system --uid 10001 --no-create-home --shell /usr/sbin/nologin lipserve \
    && mkdir --mode=700 /data && chown lipserve /data
COPY --from=build /opt/lipserve /opt/lipserve
# compiled kernels; writable, since another processor than the build's compiles its own
COPY --from=build --chown=lipserve /opt/numba /opt/numba
ENV PATH=/opt/lipserve/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/opt/numba \
    LIPSERVE_HOME=/data \
    LIPSERVE_HOST=0.0.0.0
# a container listens on all its addresses to be reached, so the service asks for API keys; make the first one with
# `docker exec CONTAINER lipserve keys create --name admin --scope admin`
VOLUME /data
EXPOSE 8000 8001
USER lipserve
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/health/ready', timeout=2)"]
CMD ["lipserve", "serve"]
