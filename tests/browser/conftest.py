"""A headless Chromium for the pages; without one these tests are skipped, and say so."""

import os
import shutil

import pytest

SIZES = [(1440, 900), (800, 600)]


def pytest_collection_modifyitems(items):
    for item in items:
        if "browser" in item.path.parts:
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """The browser, driven over its standard protocol."""
    webdriver = pytest.importorskip("selenium.webdriver")
    binary = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("NOT COVERED: no chromium or chromedriver on this machine")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    profile = tmp_path_factory.mktemp("profile")
    for flag in (
        "headless=new",
        "no-sandbox",
        "disable-gpu",
        "disable-dev-shm-usage",
        "disable-quic",
        "no-first-run",
        "disable-background-networking",
        "disable-component-update",
        "disable-sync",
        f"user-data-dir={profile}",
    ):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(driver, env={**os.environ, "HOME": str(profile)})
    browser = webdriver.Chrome(options=options, service=service)
    browser.set_script_timeout(30)
    yield browser
    browser.quit()


class Page:
    """What the tests do with a page."""

    def __init__(self, browser):
        self.browser = browser

    def open(self, address, size=SIZES[0], ready="document.documentElement.dataset.ready"):
        """Show a page and wait until it says that it is ready."""
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        self.browser.get("about:blank")
        self.browser.get_log("browser")
        self.browser.get(address)
        self.wait(ready)

    def prefer(self, mode):
        """Let the browser ask for light or dark pages, until the end of the test."""
        self.emulate(features=[{"name": "prefers-color-scheme", "value": mode}])

    def emulate(self, media="", features=()):
        """What the page is shown on, such as `print`."""
        values = {"media": media, "features": list(features)}
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", values)

    def run(self, script):
        """Value of an expression in the page."""
        return self.browser.execute_script(f"return {script}")

    def wait(self, condition, seconds=20):
        """Wait until an expression holds."""
        from selenium.webdriver.support.ui import WebDriverWait

        WebDriverWait(self.browser, seconds, poll_frequency=0.05).until(
            lambda _: self.run(condition), f"never became true: {condition}"
        )

    def press(self, *keys):
        """Keys, as typed on the page."""
        from selenium.webdriver.common.action_chains import ActionChains

        for key in keys:
            ActionChains(self.browser).send_keys(key).perform()

    def click(self, element_id):
        """Click an element."""
        self.browser.find_element("id", element_id).click()

    def text(self, element_id):
        """Text of an element."""
        return self.run(f"document.getElementById({element_id!r}).textContent")

    def click_at(self, x, y):
        """Click a point of the scene, in pixels from its corner."""
        script = """
            const canvas = document.getElementById("scene");
            const box = canvas.getBoundingClientRect();
            for (const kind of ["pointerdown", "pointerup"]) {
              const at = {clientX: box.left + arguments[0], clientY: box.top + arguments[1]};
              const event = new PointerEvent(kind, {...at, bubbles: true, pointerId: 1});
              (kind === "pointerup" ? window : canvas).dispatchEvent(event);
            }"""
        self.browser.execute_script(script, x, y)

    def pixels(self, element_id="scene"):
        """Digest of what a canvas shows."""
        return self.run(f"document.getElementById({element_id!r}).toDataURL()")

    def shoot(self, path):
        """A picture of the page."""
        assert self.browser.save_screenshot(str(path))

    def complaints(self):
        """Errors and warnings on the console since the page was opened."""
        return [entry for entry in self.browser.get_log("browser") if entry["level"] != "INFO"]


@pytest.fixture
def page(chromium):
    """The browser as one page; errors on its console fail the test."""
    out = Page(chromium)
    yield out
    out.emulate()
    assert out.complaints() == []
