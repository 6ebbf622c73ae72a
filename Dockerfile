# docker build -t gyrostab . && docker run --rm -v "$PWD:/data" gyrostab run run7.csv -o product.nc
FROM python:3.11-slim
COPY . /src
RUN pip install --no-cache-dir "/src[formats]" && rm -rf /src
# compile the kernels once
RUN gyrostab demo -o /tmp/demo --quiet-progress && rm -rf /tmp/demo
WORKDIR /data
ENTRYPOINT ["gyrostab"]
