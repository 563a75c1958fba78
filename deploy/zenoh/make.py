"""`python -m saccade.deploy.zenoh.make FOLDER --host NAME` makes the files of a bus over several hosts in a new folder.

The router gets `router.json5`, a certificate with its key, and the passwords. Each service gets `<service>.json5` and a
certificate with its key. An authority that is made here signs the certificates. Copy to each host the files of its
services and the authority's certificate, and set ZENOH_CONFIG to the .json5 file.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from saccade.deploy.zenoh.access import access_control, users
from saccade.shared.errors import SaccadeError
from saccade.shared.loop.process import EXIT_ERROR

DAYS = 825
AUTHORITY, ROUTER = "authority", "router"


def make(folder: Path, hosts: Sequence[str], where: Path | None = None) -> None:
    """Writes all files; only their owner can read them. The configurations name the files in the folder `where`, by
    default `folder`. Raises SaccadeError if the folder cannot be made, for example because it exists, or if openssl is
    missing or fails."""
    where = where or folder.resolve()
    try:
        folder.mkdir(mode=0o700, parents=True)
    except OSError as error:
        raise SaccadeError(f"{folder} cannot be made ({error.strerror}): name a new folder") from error
    _openssl("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", str(DAYS),
             "-subj", "/CN=saccade", "-keyout", folder / f"{AUTHORITY}.key", "-out", folder / f"{AUTHORITY}.pem")
    passwords = {user: secrets.token_urlsafe(24) for user in users()}
    _write(folder / "users.txt", "".join(f"{user}:{password}\n" for user, password in passwords.items()))
    names = [f"IP:{host}" if host.replace(".", "").isdigit() or ":" in host else f"DNS:{host}" for host in hosts]
    _certify(folder, ROUTER, ",".join(names))
    tls = {"root_ca_certificate": str(where / f"{AUTHORITY}.pem"), "enable_mtls": True}
    _write_tree(folder / f"{ROUTER}.json5", {
        "transport": {"link": {"tls": {**tls, **_pair(where, ROUTER, "listen")}},
                      "auth": {"usrpwd": {"dictionary_file": str(where / "users.txt")}}},
        "access_control": access_control()})
    for user, password in passwords.items():
        _certify(folder, user, f"DNS:{user}")
        _write_tree(folder / f"{user}.json5", {
            "transport": {"link": {"tls": {**tls, **_pair(where, user, "connect")}},
                          "auth": {"usrpwd": {"user": user, "password": password}}}})


def _pair(where: Path, name: str, role: str) -> dict[str, str]:
    return {f"{role}_certificate": str(where / f"{name}.pem"), f"{role}_private_key": str(where / f"{name}.key")}


def _write_tree(path: Path, tree: dict) -> None:
    _write(path, json.dumps(tree, indent=1) + "\n")


def _write(path: Path, text: str) -> None:
    """Writes a new file that only its owner can read, from the moment it exists."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)


def _certify(folder: Path, name: str, alternative: str) -> None:
    request = folder / f"{name}.csr"
    _openssl("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", f"/CN={name}",
             "-keyout", folder / f"{name}.key", "-out", request)
    extensions = folder / f"{name}.ext"
    _write(extensions, f"subjectAltName={alternative}\nextendedKeyUsage=serverAuth,clientAuth\n")
    _openssl("x509", "-req", "-in", request, "-CA", folder / f"{AUTHORITY}.pem", "-CAkey", folder / f"{AUTHORITY}.key",
             "-CAcreateserial", "-days", str(DAYS), "-extfile", extensions, "-out", folder / f"{name}.pem")
    request.unlink()
    extensions.unlink()


def _openssl(*arguments: str | Path) -> None:
    try:
        subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True, text=True, umask=0o077)
    except OSError as error:
        raise SaccadeError("openssl is needed to make certificates: install it") from error
    except subprocess.CalledProcessError as error:
        raise SaccadeError(f"openssl {arguments[0]} failed: {error.stderr.strip().splitlines()[-1]}") from error


def main(argv: Sequence[str] | None = None) -> None:
    """Makes the folder. If it cannot, it prints one line and ends with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m saccade.deploy.zenoh.make", description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--host", action="append", required=True, help="name or address of the router; may be repeated")
    parser.add_argument("--where", type=Path, help="the folder in which the files will be on the hosts")
    told = parser.parse_args(argv)
    try:
        make(told.folder, told.host, told.where)
    except SaccadeError as error:
        print(f"saccade: {error}", file=sys.stderr)
        sys.exit(EXIT_ERROR)


if __name__ == "__main__":
    main()
