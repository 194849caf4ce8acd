//! What a plot may consist of, so that a page can take it in.

/// Elements that our plots consist of.
const PLAIN: [&str; 10] =
    ["svg", "g", "rect", "line", "polyline", "polygon", "path", "circle", "ellipse", "text"];

/// True for an SVG of plain shapes and text only, which loads nothing, runs nothing and ends where it should.
pub fn is_plain_svg(text: &str) -> bool {
    let text = text.trim();
    let plain = |tag: &str| {
        let name = tag.trim_start_matches('/').split([' ', '\n', '\r', '\t', '>', '/']).next().unwrap_or("");
        let within = tag.split('>').next().unwrap_or("").to_ascii_lowercase();
        let loads = ["href", "url(", "style", "src"].iter().any(|word| within.contains(word));
        let runs = within.split_whitespace().any(|attribute| attribute.starts_with("on"));
        PLAIN.contains(&name) && tag.contains('>') && !loads && !runs
    };
    text.starts_with("<svg") && text.ends_with("</svg>") && text.split('<').skip(1).all(plain)
}
