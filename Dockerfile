# docker build -t gyrostab .
# docker run --rm -u "$(id -u)" -v "$PWD:/data" gyrostab run run7.csv -o product.nc
FROM python:3.11-slim
COPY . /src
RUN pip install --no-cache-dir "/src[formats]" && rm -rf /src
# compile the kernels once, for every user
ENV HOME=/tmp NUMBA_CACHE_DIR=/kernels
RUN gyrostab demo -o /tmp/demo --quiet-progress && rm -rf /tmp/demo && chmod -R a+rwX /kernels /tmp
WORKDIR /data
ENTRYPOINT ["gyrostab"]
