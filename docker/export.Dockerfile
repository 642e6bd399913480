# Training and export: torch on the CPU; textures, runs and models are mounted.
FROM python:3.11-slim-bookworm
COPY pyproject.toml README.md LICENSE /src/
COPY service /src/service
COPY model_export /src/model_export
COPY migrations /src/migrations
WORKDIR /src
RUN python3 -m venv /opt/camind
# a CPU build or another source of torch: --build-arg TORCH="torch==2.13.0+cpu ..."
ARG TORCH="torch==2.13.0"
RUN /opt/camind/bin/python -m pip install --no-cache-dir ${TORCH}
RUN /opt/camind/bin/python -m pip install --no-cache-dir ".[train]"
RUN useradd --system --uid 10001 --home-dir /runs --create-home camind
ENV PATH=/opt/camind/bin:$PATH
USER 10001
VOLUME /runs
WORKDIR /runs
ENTRYPOINT ["camind"]
CMD ["--help"]
