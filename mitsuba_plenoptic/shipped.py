SHIPPED: dict[str, dict[str, str]] = {}
