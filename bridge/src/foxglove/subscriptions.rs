//! Which channels a client is subscribed to.

/// Most subscriptions of a client: some to each channel.
const MOST: usize = 64;

/// The subscriptions of a client, whose numbers it chooses.
#[derive(Debug)]
pub struct Subscriptions {
    num_channels: usize,
    /// Number and channel of each.
    all: Vec<(u32, usize)>,
}

impl Subscriptions {
    /// None yet, to channels 0 to `num_channels`.
    pub fn new(num_channels: usize) -> Self {
        Self { num_channels, all: Vec::new() }
    }

    /// Adds one and gives its channel, or says why not.
    pub fn add(&mut self, subscription: u32, channel: u32) -> Result<usize, String> {
        let known = usize::try_from(channel).ok().filter(|channel| *channel < self.num_channels);
        let Some(channel) = known else {
            return Err(format!("there is no channel {channel}"));
        };
        if self.all.iter().any(|(id, _)| *id == subscription) {
            return Err(format!("there is a subscription {subscription} already"));
        }
        if self.all.len() >= MOST {
            return Err(format!("a client can have {MOST} subscriptions"));
        }
        self.all.push((subscription, channel));
        Ok(channel)
    }

    /// Removes one, if it is there.
    pub fn remove(&mut self, subscription: u32) {
        self.all.retain(|(id, _)| *id != subscription);
    }

    /// Whether anything is subscribed to a channel.
    pub fn has(&self, channel: usize) -> bool {
        self.all.iter().any(|(_, subscribed)| *subscribed == channel)
    }

    /// Numbers of the subscriptions to a channel.
    pub fn of(&self, channel: usize) -> impl Iterator<Item = u32> {
        self.all.iter().filter(move |(_, subscribed)| *subscribed == channel).map(|(id, _)| *id)
    }
}
