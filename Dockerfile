# Two images of services and workers, without a C compiler and without CUDA:
#   docker build -t lipserve .                        the full image: extras train, robots, ingest, cluster and grpc
#   docker build --target serve -t lipserve:serve .   serves, streams, learns, trains learnt arms; see GET /health
FROM python:3.11-slim AS sources
RUN apt-get update && apt-get install --yes --no-install-recommends binutils libgomp1
WORKDIR /src
COPY .ci .ci
COPY pyproject.toml hatch_build.py mkdocs.yml README.md LICENSE ./
COPY clients/python clients/python
COPY lipcore lipcore
COPY service service
COPY docs docs
COPY models/panda-sim models/panda-sim

FROM sources AS build-serve
RUN .ci/install-image ./clients/python '.'

FROM sources AS build-full
RUN .ci/install-image ./clients/python '.[train,robots,ingest,cluster,grpc]'

# the system without package managers and Perl; it is copied into an empty image below, as layers cannot remove files
FROM python:3.11-slim AS system
# Pinocchio's OpenMP runtime, which slim images lack
RUN apt-get update && apt-get install --yes --no-install-recommends libgomp1 \
    && useradd --system --uid 10001 --no-create-home --shell /usr/sbin/nologin lipserve \
    && mkdir --mode=700 /data && chown lipserve /data \
    && rm -rf /var/lib/apt/lists/* /var/cache/apt/* /usr/share/doc/* /usr/share/man/* /usr/share/locale/* \
        /usr/lib/*/gconv /usr/lib/*/perl* /usr/bin/perl* /usr/share/perl* /usr/lib/apt /usr/lib/*/libapt-* /usr/bin/apt* \
        /usr/share/zoneinfo/right /var/lib/dpkg/info \
    && for python in /usr/lib/python3* /usr/local/lib/python3*; do \
        rm -rf "$python"/ensurepip "$python"/idlelib "$python"/test "$python"/lib2to3 "$python"/pydoc_data \
            "$python"/*-packages/pip* "$python"/*-packages/setuptools* "$python"/*-packages/wheel*; \
    done; rm -rf /usr/share/python-wheels

FROM scratch AS base
COPY --from=system / /
ENV PATH=/opt/lipserve/bin:/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin \
    LANG=C.UTF-8 \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/opt/numba \
    LIPSERVE_HOME=/data \
    LIPSERVE_HOST=0.0.0.0
# The service listens on all addresses of the container, so it requires API keys. Create the first one:
# `docker exec CONTAINER lipserve keys create --name admin --scope admin`
VOLUME /data
EXPOSE 8000 8001
USER lipserve
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/health/ready', timeout=2)"]
CMD ["lipserve", "serve"]

FROM base AS serve
COPY --from=build-serve /opt/lipserve /opt/lipserve
# compiled kernels; writable, as a processor other than the build's compiles its own
COPY --from=build-serve --chown=lipserve /opt/numba /opt/numba

FROM base AS full
COPY --from=build-full /opt/lipserve /opt/lipserve
COPY --from=build-full --chown=lipserve /opt/numba /opt/numba
