FROM python:3.13-slim
COPY . /opt/upright
RUN pip install --no-cache-dir /opt/upright && useradd --create-home upright && install -d -o upright /data
USER upright
WORKDIR /data
ENTRYPOINT ["upright"]
