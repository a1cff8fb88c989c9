FROM python:3.13.15-slim-bookworm
COPY requirements.lock /opt/upright/
RUN pip install --no-cache-dir --require-hashes --requirement /opt/upright/requirements.lock
COPY . /opt/upright
RUN pip install --no-cache-dir --no-index --no-deps --no-build-isolation /opt/upright \
    && useradd --create-home upright && install -d -o upright /data
USER upright
WORKDIR /data
ENTRYPOINT ["upright"]
