"""A door to a PostgreSQL server whose open connections can fall silent, as behind a firewall.

The kernel of this machine goes on answering for them, so that no limit of TCP helps.
"""

import socket
import threading
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from sqlalchemy import URL, make_url


class SilentProxy:
    """Passes bytes on between clients and a server, until `silence_all`; new ones pass again."""

    def __init__(self, server_url: str) -> None:
        (folder,) = parse_qs(urlsplit(server_url).query)["host"]
        self._target = str(next(Path(folder).glob(".s.PGSQL.*[0-9]")))
        self._silent = self._generation = 0
        self._ends: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=100)
        self.port = self._listener.getsockname()[1]
        self._user = urlsplit(server_url).username or "postgres"
        threading.Thread(target=self._accept, daemon=True).start()

    def url(self, database: str) -> str:
        """Address of a database behind the door."""
        made = URL.create("postgresql+psycopg", self._user, None, "127.0.0.1", self.port, database)
        return make_url(made).render_as_string(hide_password=False)

    def silence_all(self) -> None:
        """From now on nothing passes through the connections that are open."""
        self._silent = self._generation

    def close(self) -> None:
        """End everything."""
        self._listener.close()
        for end in self._ends:
            end.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.socket(socket.AF_UNIX)
            try:
                server.connect(self._target)
            except OSError:  # the server is away
                client.close()
                continue
            self._ends += [client, server]
            self._generation += 1
            for source, sink in ((client, server), (server, client)):
                given = source, sink, self._generation
                threading.Thread(target=self._pump, args=given, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, generation: int) -> None:
        try:
            while data := source.recv(65_536):
                if generation > self._silent:
                    sink.sendall(data)
            if generation > self._silent:
                sink.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
