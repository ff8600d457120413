/** Server-sent events, read by hand: the browser's own reader sends no token. */

export interface Message {
  id: string | null;
  event: string;
  data: string;
}

/** Takes text as it comes and gives back whole messages. */
export class Messages {
  private rest = "";

  /** The messages that `text` completes. Comments, such as the sign of life, are none. */
  take(text: string): Message[] {
    this.rest += text;
    const found: Message[] = [];
    for (let end = this.rest.indexOf("\n\n"); end >= 0; end = this.rest.indexOf("\n\n")) {
      const message = parse(this.rest.slice(0, end));
      this.rest = this.rest.slice(end + 2);
      if (message) found.push(message);
    }
    return found;
  }
}

function parse(block: string): Message | null {
  const message: Message = { id: null, event: "message", data: "" };
  let told = false;
  for (const line of block.split("\n")) {
    const colon = line.indexOf(":");
    if (colon <= 0) continue;
    const value = line.slice(colon + 1).replace(/^ /, "");
    const name = line.slice(0, colon);
    if (name === "id") message.id = value;
    if (name === "event") message.event = value;
    if (name === "data") {
      message.data += (told ? "\n" : "") + value;
      told = true;
    }
  }
  return told ? message : null;
}
