# The S3 server of compose.yaml. MinIO has published no images since October 2025: only sources. Its
# last image is before the repair of CVE-2025-62506, and can no longer be relied on to be there.
# The digests of the bases could not be looked up where this was written. Pin them when you build:
#   docker compose build --build-arg GO=golang:1.25-bookworm@sha256:… store
ARG GO=golang:1.25-bookworm
ARG BASE=debian:bookworm-slim

FROM ${GO} AS build
# Go checks the sources of a version by its public log of checksums (GOSUMDB).
ENV CGO_ENABLED=0 GOTOOLCHAIN=auto
RUN go install -trimpath -ldflags="-s -w" github.com/minio/minio@RELEASE.2025-10-15T17-29-55Z \
 && go install -trimpath -ldflags="-s -w" github.com/minio/mc@RELEASE.2025-08-13T08-35-41Z

FROM ${BASE}
COPY --from=build /go/bin/minio /go/bin/mc /usr/local/bin/
# Root, as in the images of MinIO: the files of an earlier volume belong to it.
VOLUME /data
CMD ["minio", "server", "/data"]
