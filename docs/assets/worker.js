// Search without a server: browsers start no workers from files. There, the script of the worker
// runs in a hidden frame, and messages are events of that frame.
if (location.protocol === "file:") {
  window.Worker = class {
    constructor(address) {
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow;
      inside.postMessage = (data) => this.onmessage?.({ data: structuredClone(data) });
      const script = inside.document.createElement("script");
      script.src = address;
      this.loaded = new Promise((done) => (script.onload = done));
      inside.document.body.append(script);
      this.frame = frame;
    }

    postMessage(data) {
      const event = { data: structuredClone(data) };
      this.loaded.then(() => {
        const inside = this.frame.contentWindow;
        inside?.dispatchEvent(new inside.MessageEvent("message", event));
      });
    }

    terminate() {
      this.frame.remove();
    }
  };
}
