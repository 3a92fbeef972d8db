"""The operator's page: what the limb does, in a browser, and the buttons that command it.

`node` brings the graph's messages, `situation` and `picture` keep what is shown of them, `access`
says who may reach the page and command, `commands` calls the graph's services, and `server` serves
the data; `window`, `drawing_panel` and `setup_guide` lay out what the browser shows.
"""
