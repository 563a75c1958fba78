"""python -m services.router --config FILE: where the other services meet; a Zenoh router at the bus's endpoint."""

from services.router.core import main

if __name__ == "__main__":
    main()
