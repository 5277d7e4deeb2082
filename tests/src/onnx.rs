//! Small ONNX models, written field by field: an ONNX file is one protocol buffer message, `ModelProto` of `onnx.proto`.

/// Opset of the models: the last whose shape operators take attributes.
const OPSET: i64 = 12;

/// Type of the values of a tensor, with its number in `TensorProto.DataType`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Element {
    /// 32-bit floats.
    Float = 1,
    /// 64-bit integers.
    Int64 = 7,
    /// Truth values.
    Bool = 9,
    /// 64-bit floats, which models for us do not have.
    Double = 11,
}

/// Attribute of a node.
#[derive(Clone, Copy, Debug)]
pub enum Attribute<'a> {
    /// One integer.
    Int(i64),
    /// Several integers.
    Ints(&'a [i64]),
}

/// A graph of operators in the order in which they are added.
#[derive(Clone, Debug, Default)]
pub struct Model {
    graph: Vec<u8>,
}

/// Appends a field whose value is a number.
fn number(message: &mut Vec<u8>, field: u64, value: i64) {
    varint(message, field << 3);
    varint(message, value as u64);
}

/// Appends a field whose value is bytes: a text, or a message.
fn bytes(message: &mut Vec<u8>, field: u64, value: &[u8]) {
    varint(message, field << 3 | 2);
    varint(message, value.len() as u64);
    message.extend(value);
}

fn varint(message: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        message.push(value as u8 | 0x80);
        value >>= 7;
    }
    message.push(value as u8);
}

/// `ValueInfoProto`; lengths below 0 vary.
fn value(name: &str, element: Element, shape: &[i64]) -> Vec<u8> {
    let mut dimensions = Vec::new();
    for (axis, length) in shape.iter().enumerate() {
        let mut dimension = Vec::new();
        if *length < 0 {
            bytes(&mut dimension, 2, format!("{name}{axis}").as_bytes());
        } else {
            number(&mut dimension, 1, *length);
        }
        bytes(&mut dimensions, 1, &dimension);
    }
    let (mut tensor, mut kind, mut value) = (Vec::new(), Vec::new(), Vec::new());
    number(&mut tensor, 1, element as i64);
    bytes(&mut tensor, 2, &dimensions);
    bytes(&mut kind, 1, &tensor);
    bytes(&mut value, 1, name.as_bytes());
    bytes(&mut value, 2, &kind);
    value
}

impl Model {
    /// Adds an input; lengths below 0 vary.
    #[must_use]
    pub fn input(mut self, name: &str, element: Element, shape: &[i64]) -> Self {
        bytes(&mut self.graph, 11, &value(name, element, shape));
        self
    }

    /// Adds an output; lengths below 0 vary.
    #[must_use]
    pub fn output(mut self, name: &str, element: Element, shape: &[i64]) -> Self {
        bytes(&mut self.graph, 12, &value(name, element, shape));
        self
    }

    fn initializer(mut self, name: &str, element: Element, shape: &[i64], raw: &[u8]) -> Self {
        let mut tensor = Vec::new();
        for length in shape {
            number(&mut tensor, 1, *length);
        }
        number(&mut tensor, 2, element as i64);
        bytes(&mut tensor, 8, name.as_bytes());
        bytes(&mut tensor, 9, raw);
        bytes(&mut self.graph, 5, &tensor);
        self
    }

    /// Adds constant floats.
    #[must_use]
    pub fn floats(self, name: &str, shape: &[i64], values: &[f32]) -> Self {
        let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.initializer(name, Element::Float, shape, &raw)
    }

    /// Adds constant integers.
    #[must_use]
    pub fn integers(self, name: &str, shape: &[i64], values: &[i64]) -> Self {
        let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.initializer(name, Element::Int64, shape, &raw)
    }

    /// Adds an operator.
    #[must_use]
    pub fn node(self, operator: &str, inputs: &[&str], output: &str) -> Self {
        self.node_with(operator, inputs, output, &[])
    }

    /// Adds an operator with attributes.
    #[must_use]
    pub fn node_with(
        mut self,
        operator: &str,
        inputs: &[&str],
        output: &str,
        attributes: &[(&str, Attribute<'_>)],
    ) -> Self {
        let mut node = Vec::new();
        for input in inputs {
            bytes(&mut node, 1, input.as_bytes());
        }
        bytes(&mut node, 2, output.as_bytes());
        bytes(&mut node, 4, operator.as_bytes());
        for (name, value) in attributes {
            let mut attribute = Vec::new();
            bytes(&mut attribute, 1, name.as_bytes());
            match value {
                Attribute::Int(value) => {
                    number(&mut attribute, 3, *value);
                    number(&mut attribute, 20, 2);
                }
                Attribute::Ints(values) => {
                    for value in *values {
                        number(&mut attribute, 8, *value);
                    }
                    number(&mut attribute, 20, 7);
                }
            }
            bytes(&mut node, 5, &attribute);
        }
        bytes(&mut self.graph, 1, &node);
        self
    }

    /// The file.
    #[must_use]
    pub fn file(mut self) -> Vec<u8> {
        bytes(&mut self.graph, 2, b"test");
        let (mut opset, mut model) = (Vec::new(), Vec::new());
        bytes(&mut opset, 1, b"");
        number(&mut opset, 2, OPSET);
        number(&mut model, 1, 7);
        bytes(&mut model, 7, &self.graph);
        bytes(&mut model, 8, &opset);
        model
    }
}
