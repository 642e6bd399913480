# The service: no torch, no onnx, no compiler, no root, nothing written but /data.
FROM python:3.11-slim-bookworm AS build
COPY pyproject.toml README.md LICENSE /src/
COPY requirements /src/requirements
COPY service /src/service
COPY model_export /src/model_export
COPY migrations /src/migrations
WORKDIR /src
RUN python3 -m venv /opt/camind
RUN /opt/camind/bin/python -m pip install --no-cache-dir --require-hashes -r requirements/pip.txt
RUN /opt/camind/bin/python -m pip install --no-cache-dir --require-hashes -r requirements/service.txt
RUN /opt/camind/bin/python -m pip install --no-cache-dir --no-deps --build-constraint requirements/build.txt .

FROM python:3.11-slim-bookworm
# it comes without bytecode, which nobody may write later: each start and each look at its health would compile anew
RUN python3 -m compileall -q -x site-packages /usr/local/lib/python3.*
RUN useradd --system --uid 10001 --home-dir /data --create-home camind
COPY --from=build /opt/camind /opt/camind
ENV PATH=/opt/camind/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    CAMIND_DATA_DIR=/data \
    CAMIND_HOST=0.0.0.0 \
    CAMIND_PORT=8000 \
    CAMIND_LOG_FORMAT=json
USER 10001
VOLUME /data
EXPOSE 8000
# by no proxy, which Docker may have set for all containers
HEALTHCHECK --interval=30s --timeout=3s --start-period=20s CMD ["python3", "-c", "import os, urllib.request as u; u.build_opener(u.ProxyHandler({})).open('http://127.0.0.1:' + os.environ['CAMIND_PORT'] + '/health/ready', timeout=2)"]
ENTRYPOINT ["camind"]
CMD ["serve"]
