// Search in pages that are opened from a folder: browsers start no worker for file: addresses, so its script runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      this.waiting = [];
      const url = new URL(address, location.href).href;
      const start = () => {
        const frame = document.createElement("iframe");
        frame.hidden = true;
        document.body.appendChild(frame);
        this.frame = frame;
        const inner = frame.contentWindow;
        const load = (source) =>
          new Promise((done, failed) => {
            const script = inner.document.createElement("script");
            script.src = new URL(source, url).href;
            script.onload = done;
            script.onerror = failed;
            inner.document.head.appendChild(script);
          });
        inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
        inner.importScripts = (...sources) => sources.reduce((before, source) => before.then(() => load(source)), Promise.resolve());
        load(url).then(() => {
          this.inner = inner;
          this.waiting.splice(0).forEach((data) => this.postMessage(data));
        });
      };
      if (document.body) start();
      else addEventListener("DOMContentLoaded", start);
    }
    postMessage(data) {
      if (this.inner) this.inner.dispatchEvent(new this.inner.MessageEvent("message", { data }));
      else this.waiting.push(data);
    }
    terminate() {
      this.frame?.remove();
    }
  };
}
